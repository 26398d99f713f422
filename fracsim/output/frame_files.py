"""Frames of a run: the fields that a frame has, and the files to which it is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import ufl
from ufl.core.expr import Expr

from ..forms.energies import Energy, full_cauchy_stress, von_mises
from ..forms.kinematics import deformation_gradient, embed, green_strain
from ..mechanics.balance import Balance
from ..mechanics.jit import CellExpression
from ..mechanics.stress import Stress
from ..mechanics.term_protocols import OutputSurfaces, SurfaceSeparator, fulfilling
from ..mesh.midside_nodes import file_cell_nodes
from ..timestepping.state import State
from .atomic_write import write_on_root
from .compressed_rows import CompressedField, RowCompressor
from .fields_file import TENSOR_COMPONENTS, Field, FieldsFile, pad_to_3d, rounded
from .fracture_log import FractureLog

if TYPE_CHECKING:
    from ..fracture.fracture_pass import FracturePass
    from ..mesh.fragments import Fragments
    from .result_checks import InterpenetrationMonitor
    from .surface.surface_output import SurfaceOutput

Values = npt.NDArray[np.generic]
_TENSOR_INDICES = [("xyz".index(name[0]), "xyz".index(name[1])) for name in TENSOR_COMPONENTS]


class FieldEvaluator:
    """Values of the fields of a frame. Expressions are compiled at the first frame."""

    def __init__(self, stress: Stress, names: list[str], fracture: FracturePass | None = None) -> None:
        """Choose the fields.

        Args:
            stress: stress term of the body.
            names: names of output.fields.
            fracture: fracture pass with the broken edges, in a study with fracture.
        """
        self._stress, self._domain, self._fracture = stress, stress.domain, fracture
        self._names = names
        self._compiled: dict[str, CellExpression] = {}

    def __call__(self, state: State, fragments: Fragments | None) -> list[Field]:
        """Displacement and the chosen fields of the nodes and cells that this rank owns (collective)."""
        d, nodes = self._domain.dim, self._domain.node_count
        fields = [Field("displacement", "Node", state.u.reshape(-1, d)[:nodes])]
        for name in self._names:
            if name == "velocity":
                fields.append(Field(name, "Node", state.v.reshape(-1, d)[:nodes]))
            elif name == "piece":
                assert fragments is not None
                fields.append(Field(name, "Node", fragments.node_fragment[:nodes].astype(np.int32)))
            else:
                fields.append(Field(name, "Cell", self._cell_values(name)))
        return fields

    def _cell_values(self, name: str) -> Values:
        """Values of a cell field on the cells of this rank, (cells,) or (cells, components)."""
        if name == "region":
            return self._domain.cell_region.astype(np.int32)
        if name == "plastic_strain":
            plastic = self._stress.material.plastic
            strain: Values = plastic.cell_means(plastic.accumulated_strain)
            return strain
        if name == "damage":
            return self._broken_share()
        if name == "chi":
            assert self._stress.chi is not None
            return self._stress.chi.x.array[: self._domain.cell_count]
        values = self._expression_values(name)
        return values[:, 0] if values.shape[1] == 1 else values

    def _broken_share(self) -> Values:
        """Share (cells,) of the edges of each cell that are broken, 0 to 1."""
        assert self._fracture is not None
        graph = self._fracture.graph
        broken = np.unpackbits(graph.pattern[:, None], axis=1).sum(axis=1)
        return np.asarray(broken / graph.cell_edges.shape[1])

    def _expression_values(self, name: str) -> Values:
        """Values (cells, components) of an expression of the deformation; stress and energy are multiplied by chi."""
        if name not in self._compiled:
            expression = _EXPRESSIONS[name](self._stress)
            domain, kernels = self._domain, self._stress.kernels
            self._compiled[name] = CellExpression(
                domain.comm, domain.mesh, expression, domain.cell_count, kernels=kernels
            )
        values = self._compiled[name]()
        if (chi := self._stress.energy_multiplier) is not None and name != "strain":
            values *= chi.x.array[: self._domain.cell_count, None]
        if self._fracture is not None and name == "strain":
            # the nodes of a split cell belong to several fragments, which have no strain in common
            values[self._fracture.graph.split] = 0.0
        # cells crushed flat have no finite stress; they carry none
        return np.nan_to_num(values, posinf=0.0, neginf=0.0)


def _kinematics(stress: Stress) -> tuple[Energy, Expr, Expr | None]:
    """Energy, deformation gradient, and rotation of the corotated energy."""
    return stress.energy, deformation_gradient(stress.u), stress.rotation_field


def _cauchy_stress(stress: Stress) -> Expr:
    """Components of the Cauchy stress in the order of `TENSOR_COMPONENTS`, Pa."""
    tensor = full_cauchy_stress(*_kinematics(stress))
    return ufl.as_vector([tensor[i, j] for i, j in _TENSOR_INDICES])


def _von_mises(stress: Stress) -> Expr:
    """Von Mises equivalent of the Cauchy stress, Pa."""
    return von_mises(full_cauchy_stress(*_kinematics(stress)))


def _energy_density(stress: Stress) -> Expr:
    """Elastic energy per reference volume, J/m^3."""
    energy, F, rotation = _kinematics(stress)
    return energy.psi(F, rotation)


def _equivalent_strain(stress: Stress) -> Expr:
    """Equivalent Green-Lagrange strain sqrt(2/3 e:e), e the deviator of E (Mandal et al. 2022, figure 2).

    E is 3 x 3: in plane stress E33 is that of the thickness.
    """
    F = deformation_gradient(stress.u)
    E = green_strain(embed(F, stress.energy.thickness_stretch(F)))
    return ufl.sqrt(2 / 3 * ufl.inner(ufl.dev(E), ufl.dev(E)))


_EXPRESSIONS: dict[str, Callable[[Stress], Expr]] = {
    "stress": _cauchy_stress,
    "von_mises": _von_mises,
    "energy_density": _energy_density,
    "strain": _equivalent_strain,
}


class FrameFiles:
    """Writer of frames: fields.xdmf, and the split surface if the study asks for it.

    Attributes:
        surface: split surface; None without surface output.
        fields: fields.xdmf on rank 0, None on the other ranks.
    """

    def __init__(
        self,
        folder: Path,
        balance: Balance,
        breaking: FracturePass | None,
        breaks: FractureLog,
        *,
        fields: list[str],
        surface: bool,
        smooth: bool = False,
        passing: InterpenetrationMonitor | None = None,
        resume_at: float | None = None,
        thickness: float = 1.0,
        precision: str,
    ) -> None:
        """Open the files (collective).

        Args:
            folder: output folder.
            balance: balance of forces of the body.
            breaking: fracture pass, in a study with fracture.
            breaks: log of broken edges.
            fields: names of output.fields.
            surface: write the split surface.
            smooth: draw cracks smooth.
            passing: monitor of interpenetration.
            resume_at: keep the frames up to this time, s; None: a new run.
            thickness: thickness of a 2D body, m; 1 in 3D.
            precision: of points and fields, "single" or "double".

        Raises:
            CannotWrite: a file cannot be written.
        """
        stress = balance.stress
        self._comm, self._path, self._breaks = stress.domain.comm, folder / "fields.xdmf", breaks
        self._evaluate = FieldEvaluator(stress, fields, breaking)
        domain, numbering = stress.domain, stress.domain.input_numbering
        self._compressors = {
            "Node": RowCompressor(self._comm, numbering.nodes[: numbering.owned_nodes]),
            "Cell": RowCompressor(self._comm, numbering.cells),
        }
        points = self._compressed(Field("points", "Node", pad_to_3d(domain.nodes)))
        cells = self._compressed(Field("cells", "Cell", file_cell_nodes(domain).astype(np.int32)))
        self.fields = write_on_root(self._comm, self._path, lambda: FieldsFile(folder, points, cells, resume_at))
        self._precision = precision
        self.surface = None
        if surface:
            self.surface = surface_output(
                folder, balance, breaks, passing, resume_at, thickness, smooth=smooth, precision=precision
            )

    @property
    def frame_counts(self) -> dict[str, int]:
        """Number of frames in each file (rank 0; empty on the other ranks)."""
        if self.fields is None:
            return {}
        surface_files = None if self.surface is None else self.surface.files
        of_surface = {} if surface_files is None else surface_files.frame_counts
        return {"fields.h5": len(self.fields.times), **of_surface}

    def write_frame(self, state: State) -> None:
        """Write a frame at the time of the state, if there is none yet. Raises CannotWrite (collective)."""
        fields = self._evaluate(state, self._breaks.fragments)
        compressed = [self._compress(field) for field in fields]
        write_on_root(self._comm, self._path, lambda: self._write_fields(state.t, compressed))
        if self.surface is not None:
            self.surface.write_frame(state, fields)

    def _compress(self, field: Field) -> CompressedField:
        """The field as it is written, complete on rank 0 (collective). Vectors have three components."""
        return self._compressed(replace(field, values=rounded(pad_to_3d(field.values), self._precision)))

    def _compressed(self, field: Field) -> CompressedField:
        """The field with the values that it has, complete on rank 0 (collective)."""
        compressor, values = self._compressors[field.centre], field.values
        shape = (compressor.rows, *values.shape[1:])
        return CompressedField(field.name, field.centre, shape, values.dtype, compressor(values) or [])

    def _write_fields(self, t: float, fields: list[CompressedField]) -> None:
        if self.fields is not None and t not in self.fields.times:
            self.fields.append_frame(t, fields)


def surface_output(
    folder: Path | None,
    balance: Balance,
    breaks: FractureLog,
    passing: InterpenetrationMonitor | None,
    resume_at: float | None,
    thickness: float,
    *,
    smooth: bool,
    precision: str = "single",
) -> SurfaceOutput:
    """Split surface of a run; arguments of `FrameFiles`. Without a folder nothing is written."""
    # imported here: runs without surface output do not need VTK
    from .surface.surface_output import SurfaceOutput

    density, terms = balance.stress.material.density * thickness, balance.terms
    return SurfaceOutput(
        folder, balance.domain, density, breaks.record, passing=passing, resume_at=resume_at, smooth=smooth,
        precision=precision,
        apart=fulfilling(terms, SurfaceSeparator),
        beside=fulfilling(terms, OutputSurfaces),
    )  # fmt: skip
