"""The user's own physics: objects given in Python, and plug-ins of installed packages that a study names.

A package offers plug-ins as entry points of the groups `fracsim.energies`, `fracsim.criteria` and so on. They are
looked up only when a name is not built in. A study has names and parameters, no code (docs/python.md#plug-ins).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from pydantic import AfterValidator, ValidationError, WrapValidator

from ..errors import InputError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

    from .study import Study

# group of entry points -> what a plug-in is called in messages
GROUPS = {
    "energies": "energy",
    "criteria": "criterion",
    "edge_laws": "law of an edge",
    "terms": "term of the balance",
    "loads": "load",
    "schemes": "time scheme",
    "builders": "mesh builder",
}


@dataclass(frozen=True)
class PhysicsPart:
    """A part of the user's physics: the object, or the class or function that makes it.

    Attributes:
        label: begins messages, as in "the energy yeoh of rubber 1.2".
        value: object that was given in Python, or is offered by a package.
        parameters: of the study, for a plug-in.
    """

    label: str
    value: Any
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def make(self, *arguments: Any, is_factory: bool | None = None, **context: Any) -> Any:
        """Return the object itself, or what the class or function makes.

        Args:
            arguments: first arguments of a factory.
            is_factory: whether `value` is called; None: if it is a class.
            context: further arguments, of which a factory is given those that it names.

        Raises:
            InputError: a parameter is unknown or missing, or the factory refuses it.
        """
        if not (isinstance(self.value, type) if is_factory is None else is_factory):
            if self.parameters:
                raise InputError(f"{self.label} is no class and has no parameters; remove {', '.join(self.parameters)}")
            return self.value
        factory = partial(self.value, *arguments)
        names = inspect.signature(factory).parameters
        chosen = {name: value for name, value in context.items() if name in names} | dict(self.parameters)
        try:
            inspect.signature(factory).bind(**chosen)
        except TypeError as error:
            raise InputError(f"{self.label}: {error}; its parameters are {', '.join(names) or 'none'}") from None
        try:
            return factory(**chosen)
        except (TypeError, ValueError) as error:
            raise InputError(f"{self.label} cannot be made: {error}") from error


def find_plugin(group: str, name: str, parameters: Mapping[str, Any] | None = None) -> PhysicsPart | None:
    """Return the plug-in of a name, with its parameters; None if no installed package has it.

    Raises:
        InputError: two packages have it, or it cannot be imported.
    """
    entry_points = _entry_points(group, name)
    if not entry_points:
        return None
    packages = sorted({_package(entry) for entry in entry_points})
    label = f"the {GROUPS[group]} {name}"
    if len(packages) > 1:
        raise InputError(f"{label} is offered by {' and '.join(packages)}: remove one of these packages")
    try:
        value = entry_points[0].load()
    except Exception as error:
        raise InputError(f"{label} of {packages[0]} cannot be imported: {type(error).__name__}: {error}") from error
    return PhysicsPart(f"{label} of {packages[0]}", value, parameters or {})


def _entry_points(group: str, name: str) -> list[EntryPoint]:
    from importlib.metadata import entry_points

    return list(entry_points(group=f"fracsim.{group}", name=name))


def _package(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else "an unknown package"


def plugin_names(group: str) -> list[str]:
    """Return the names that installed packages have in a group."""
    from importlib.metadata import entry_points

    return sorted({entry.name for entry in entry_points(group=f"fracsim.{group}")})


def or_plugin(group: str) -> WrapValidator:
    """Return a validator of a key with built-in names, which accepts names of plug-ins as well."""

    def validate(value: Any, built_in: Callable[[Any], Any]) -> Any:
        try:
            return built_in(value)
        except ValidationError:
            if isinstance(value, str) and _entry_points(group, value):
                return value
            raise

    return WrapValidator(validate)


def installed(group: str) -> AfterValidator:
    """Return a validator of a name, which an installed package must have."""

    def validate(name: str) -> str:
        if not _entry_points(group, name):
            offered = ", ".join(plugin_names(group)) or "none"
            raise ValueError(f"no installed package has the {GROUPS[group]} {name}; installed: {offered}")
        return name

    return AfterValidator(validate)


@dataclass(frozen=True)
class Physics:
    """The user's own physics, in place of that which the study names or beside it.

    Attributes:
        energy: object with `psi(F)`, or a class or function that makes one of `mu`, `lmbda` and `mesh` or some of them.
        criterion: function `load(stress, edges, strength)`.
        edge_law: function of loads that returns integrities.
        scheme: time scheme, or its class; the study has it as well (`Study.with_scheme`).
        builder: of the mesh, which the study has as well.
        terms: classes or functions that make a term of `TermInputs` (scene.terms).
        boundary: entries as in [[boundary]], whose value is a function of t, or of t and x.
        loads: what made these entries.
    """

    energy: PhysicsPart | None = None
    criterion: PhysicsPart | None = None
    edge_law: PhysicsPart | None = None
    scheme: PhysicsPart | None = None
    builder: PhysicsPart | None = None
    terms: tuple[PhysicsPart, ...] = ()
    boundary: tuple[Mapping[str, Any], ...] = ()
    loads: tuple[PhysicsPart, ...] = ()

    @property
    def lines(self) -> list[str]:
        """Lines of study.toml that record the physics."""
        single = (self.energy, self.criterion, self.edge_law, self.scheme, self.builder)
        parts = [part for part in (*single, *self.terms, *self.loads) if part is not None]
        return [f"physics: {part.label}" for part in parts]


NO_PHYSICS = Physics()


def physics_lines(text: str) -> list[str]:
    """Return the lines of a study.toml that record the user's physics."""
    return [line.removeprefix("# ") for line in text.splitlines() if line.startswith("# physics: ")]


def collect_physics(
    study: Study,
    *,
    energy: Any = None,
    criterion: Any = None,
    edge_law: Any = None,
    scheme: Any = None,
    terms: Sequence[Any] = (),
    boundary: Sequence[Mapping[str, Any]] = (),
) -> Physics:
    """Return the physics given in Python (the arguments are those of `Physics`), and else that which a study names.

    Raises:
        InputError: a plug-in cannot be imported.
    """
    named: dict[str, list[PhysicsPart]] = {}
    for group, name in study.plugin_names:
        # a builder has its parameters in [mesh]
        if (part := find_plugin(group, name, study.plugin.get(name))) is not None:
            named.setdefault(group, []).append(part)

    def first(group: str, value: Any) -> PhysicsPart | None:
        if value is not None:
            return given_part(group, value)
        return named[group][0] if group in named else None

    loads, entries = list(named.get("loads", [])), list[Mapping[str, Any]]()
    for part in loads:
        result = part.make(is_factory=True)
        entries += [result] if isinstance(result, Mapping) else list(result)
    for entry in boundary:
        function = next((value for value in entry.values() if callable(value)), entry)
        loads.append(given_part("loads", function))
        entries.append(entry)
    all_terms = (*named.get("terms", []), *(given_part("terms", term) for term in terms))
    parts = (first("energies", energy), first("criteria", criterion), first("edge_laws", edge_law))
    return Physics(
        *parts,
        first("schemes", scheme),
        first("builders", None),
        terms=all_terms,
        boundary=tuple(entries),
        loads=tuple(loads),
    )


def given_part(group: str, value: Any) -> PhysicsPart:
    """Return a part that is given in Python."""
    name = getattr(value, "__qualname__", type(value).__qualname__)
    module = getattr(value, "__module__", None) or type(value).__module__
    return PhysicsPart(f"the {GROUPS[group]} {module}.{name} given in Python", value)
