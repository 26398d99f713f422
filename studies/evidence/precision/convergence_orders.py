"""Convergence of linear and quadratic cells to a smooth manufactured solution (manufactured_solution.py)."""

from __future__ import annotations

from ..trial import Trial
from .case_section import AccuracyCase, ExpectedOrder, Records, measured_errors
from .precision_trials import script_trial

ENERGIES = ("linear", "corotated", "stvk", "neo-hookean")
CELLS = {2: (6, 12, 24), 3: (3, 6, 12)}  # along a side, by dimension
ERRORS = ("displacement", "gradient")
KINDS = [*((2, energy) for energy in ENERGIES), (3, "neo-hookean")]


def _trial_name(dim: int, energy: str, order: int, cells: int) -> str:
    """Name of a trial."""
    return f"{energy}-{dim}d-order-{order}-{cells}"


def trials() -> list[Trial]:
    """Trials of all energies in 2D, and of the neo-Hookean one in 3D."""
    return [
        script_trial("smooth", _trial_name(dim, energy, order, cells), "manufactured_solution",
               {"energy": energy, "dim": dim, "order": order, "h": 1 / cells},
               {"energy": energy, "dim": dim, "order": order, "h": 1 / cells})
        for dim, energy in KINDS for order in (1, 2) for cells in CELLS[dim]
    ]  # fmt: skip


def _expected_order(dim: int, energy: str, order: int, error: str) -> ExpectedOrder:
    """Expected order of one error."""
    names = tuple(_trial_name(dim, energy, order, cells) for cells in CELLS[dim])
    theory = order + (error == "displacement")
    return ExpectedOrder(error, "h", theory, names, of=f"{energy} in {dim}D, cells of order {order}:")


def _text(records: Records) -> str:
    """Text of the section."""
    return (
        "A square or cube of 1 m with strains of 0.3 and rotations of 0.2, under the load that makes them: errors in "
        "L2 of the displacement and of its gradient."
    )


CASES = [
    AccuracyCase(
        "smooth", "A smooth displacement", _text, ("energy", "dim", "order", "h"), measured_errors(*ERRORS), ERRORS,
        tuple(_expected_order(dim, energy, order, error) for dim,
              energy in KINDS for order in (1, 2) for error in ERRORS),
        split="order", compare_cost=False,
    )
]  # fmt: skip
