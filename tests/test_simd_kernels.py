"""Forms of several cells at a time are those that DOLFINx assembles one cell after another."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from dolfinx import fem

from fracsim.mechanics import simd_kernels
from fracsim.mechanics.jit import jit_options
from fracsim.mechanics.kernel_selection import KernelSelection
from fracsim.mechanics.matrix_assembly import TangentAssembler
from fracsim.mechanics.simd_kernels import (
    SimdBilinearForm,
    SimdExpression,
    SimdFunctional,
    SimdLinearForm,
    compile_simd_form,
    vectorise_kernel,
)
from fracsim.mesh import c_library as compiling
from fracsim.mesh.dolfinx_compat import evaluate, kernel_source
from fracsim.scene import terms
from support.scenes import Values, make_scene
from test_dead_cells import damaged

MATERIAL = {"young": 1e3, "poisson": 0.3, "density": 10.0}
SIDE = [{"on": "left", "displacement": [0.1, "free", "free"]}]


def summed(form: fem.Form, bcs: list[fem.DirichletBC], *, lanes: bool, by_blocks: bool) -> Values:
    """Entries of a form in a matrix with room for just them."""
    assembly = TangentAssembler(form)
    if by_blocks:
        assembly.switch_to_blocks()
    assert assembly.matrix.getSize()  # made at its first use
    assembly._sum.data[:] = 0.0
    if lanes:
        several = SimdBilinearForm.for_form(form, assembly._sum)
        assert several is not None
        several.add_to(assembly._sum, bcs)
    else:
        fem.assemble_matrix(assembly._sum, form, bcs)  # type: ignore[arg-type]
    values: Values = assembly._sum.data.copy()
    return values


def assert_as_one_by_one(form: fem.Form, bcs: list[fem.DirichletBC]) -> None:
    for by_blocks in (True, False):
        ours, theirs = (summed(form, bcs, lanes=lanes, by_blocks=by_blocks) for lanes in (True, False))
        largest = np.abs(theirs[theirs != 1.0]).max()  # beside rows of prescribed dofs
        assert largest > 0
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-13 * largest)


@pytest.mark.parametrize(("case", "dim"), [("damped", 2), ("damped", 3), ("rotated", 3), ("extrapolated", 3)])
def test_as_one_by_one(case: str, dim: int) -> None:
    """A body that is deformed and flows at random, a third of its cells dead, held at one side along one axis."""
    balance = damaged(case, dim, boundary=[SIDE[0] | {"displacement": [0.1, "free", "free"][:dim]}])[0].balance
    balance.damage_changed()
    assert_as_one_by_one(balance.tangent.form, balance.motion.bcs)


@pytest.mark.parametrize(("case", "dim"), [("damped", 2), ("damped", 3), ("extrapolated", 3)])
def test_forces_as_one_by_one(case: str, dim: int) -> None:
    """Of the same bodies, with dead cells and without, and moved otherwise: to the last digits."""
    balance = damaged(case, dim, boundary=[SIDE[0] | {"displacement": [0.1, "free", "free"][:dim]}])[0].balance
    form, assembler = balance._work, balance._assembler
    code = compile_simd_form(form)
    assert code is not None
    for change in (
        lambda: None,
        balance.damage_changed,
        lambda: balance.set_displacement(-3 * balance.u.x.array[: balance.owned_dof_count]),
    ):
        change()
        theirs, ours = assembler.create_vector(), assembler.create_vector()
        assembler.assemble_local_part(theirs, form)
        with ours.localForm() as local:
            local.set(0.0)
            SimdLinearForm(form, code).add_to(local.array_w)
        one, other = theirs.array_r, ours.array_r
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-14 * np.abs(other).max())
        assert np.abs(other).max() > 0


@pytest.mark.parametrize(("case", "dim"), [("damped", 2), ("damped", 3), ("rotated", 3), ("extrapolated", 3)])
def test_energies_as_one_by_one(case: str, dim: int) -> None:
    """Of the same bodies, moved otherwise, and of one that has a node nowhere."""
    balance = damaged(case, dim, boundary=[SIDE[0] | {"displacement": [0.1, "free", "free"][:dim]}])[0].balance
    form = balance.stress._energy_form
    several = SimdFunctional.for_form(form)
    assert several is not None
    found = []
    for factor in (1.0, -3.0, np.nan):
        balance.set_displacement(factor * balance.u.x.array[: balance.owned_dof_count])
        expected = fem.assemble_scalar(form)
        found.append(several.integrate())
        np.testing.assert_allclose(found[-1], expected, rtol=1e-13)
    assert 0 < found[0] != found[1]


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("energy", ("linear", "corotated", "stvk", "neo-hookean"))
def test_expressions_as_one_by_one(energy: str, dim: int) -> None:
    """Stress and energy of a body that moves at random, of a number of cells that is no multiple of the lanes, are
    DOLFINx's to the last digit; the fields they are made of are looked up anew."""
    mesh = {"builder": "box", "size": [1.0, 0.7, 0.5][:dim], "h": 0.2}
    scene, _ = make_scene(mesh=mesh, material=MATERIAL | {"energy": energy}, fracture={"strength": 1.0})
    expression, balance = scene.fracture._undamaged._evaluate, scene.balance
    compiled_one = expression._compiled
    lanes = SimdExpression.for_expression(
        compiled_one, expression.mesh, kernel_source(compiled_one, expression.mesh, jit_options())
    )
    assert lanes is not None and expression._kernel is None
    rng = np.random.default_rng(5)
    for _ in range(2):
        balance.set_displacement(rng.uniform(-0.02, 0.02, balance.owned_dof_count))
        cells = rng.permutation(len(expression._all))[: -3 + len(expression._all) // 4 * 4].astype(np.int32)
        ours, theirs = np.full((2, len(cells), expression.width), np.nan)
        lanes(cells, ours)
        evaluate(compiled_one, expression.mesh, cells, theirs)
        np.testing.assert_array_equal(ours, theirs)
        assert np.abs(theirs).max() > 0


def test_large_bodies_that_break_are_looked_at_several_cells_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same where the size of a body decides, and crushed cells are counted as before."""
    found = []
    for many in (1, 10**9):
        selection = KernelSelection(min_cells=many)
        monkeypatch.setattr(terms, "KernelSelection", lambda selection=selection, **_: selection)
        scene, _ = make_scene(mesh={"builder": "box", "size": [1.0, 0.7], "h": 0.2}, fracture={"strength": 1.0})
        u = np.random.default_rng(5).uniform(-0.02, 0.02, scene.balance.owned_dof_count)
        u[3] = np.nan
        scene.balance.set_displacement(u)
        assert (scene.fracture._undamaged._evaluate._kernel is None) == (many > 1)
        found.append((*map(np.copy, scene.fracture.evaluate_undamaged_stress()), scene.fracture.nonfinite_cells))
    (ours, energy, crushed), (theirs, expected, count) = found
    np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(energy, expected)
    assert crushed == count > 0


def test_what_is_no_number_is_told() -> None:
    """Where a node is nowhere nothing around it is a number: Newton's method has to see it."""
    balance = damaged("damped", 3, boundary=SIDE)[0].balance
    u = balance.u.x.array[: balance.owned_dof_count].copy()
    u[4] = np.nan
    balance.set_displacement(u)
    code, b = compile_simd_form(balance._work), balance._assembler.create_vector()
    assert code is not None
    SimdLinearForm(balance._work, code).add_to(b.array_w)
    nowhere = np.isnan(balance._assembler(balance._work))
    assert nowhere.any() and not nowhere.all()
    np.testing.assert_array_equal(np.isnan(b.array_r), nowhere)


def test_psd_form() -> None:
    """The same of the form that is added where moduli are made positive, of a body that is crushed at random."""
    balance = damaged("damped", 3, boundary=SIDE)[0].balance
    balance.set_displacement(np.random.default_rng(6).uniform(-0.2, 0.2, balance.owned_dof_count))
    assert_as_one_by_one(balance.tangent._psd_form(0.1, has_inertia=True), balance.motion.bcs)


def test_what_dolfinx_goes_on_with() -> None:
    """Forms with integrals over facets, and of bent cells."""
    assert compile_simd_form(damaged("rotated", 3)[0].balance.tangent.form) is None
    bent = {"builder": "box", "size": [1.0, 0.7], "h": 0.4, "order": 2}
    assert (
        compile_simd_form(
            damaged("rotated", 2, mesh=bent, boundary=[{"on": "left", "fix": "xy"}])[0].balance.tangent.form
        )
        is None
    )


def test_cells_without_room() -> None:
    """A matrix that was made while cells were dead has no room for them, which is told."""
    balance = damaged("linear", 3)[0].balance
    balance.damage_changed()
    form = balance.tangent.form
    assembly = TangentAssembler(form)
    assembly.switch_to_blocks()
    several = SimdBilinearForm(form, compile_simd_form(form), assembly._sum)
    several.add_to(assembly._sum, [])
    balance.stress.chi.x.array[:] = 1.0
    balance.damage_changed()
    with pytest.raises(ValueError, match="no place for cell"):
        several.add_to(assembly._sum, [])


@pytest.mark.parametrize("line", ("double s = a > b ? a : b;", "double s = pow(a, b);"))
def test_what_lanes_cannot_do(line: str) -> None:
    """A choice by a condition, a function that is not taken lane by lane."""
    kernel = "\nvoid tabulate_tensor_x(double* A)\n{{\n{0}\n}}\n\nbool enabled_x[1] = {{1}};\n\nufcx_integral x\n"
    assert vectorise_kernel(kernel.format("double s = fabs(a);")) == "{\nreal s = (fabs(a)) - zero;\n}\n"
    assert vectorise_kernel(kernel.format(line)) is None
    assert vectorise_kernel("double s = fabs(a);") is vectorise_kernel("\nvoid tabulate_tensor_x(double* A);\n") is None


@pytest.mark.parametrize("compiler", [name for name in ("gcc", "clang") if shutil.which(name)])
def test_compilers(monkeypatch: pytest.MonkeyPatch, compiler: str) -> None:
    """Kernels of several cells by GCC and Clang, as far as they are installed."""
    monkeypatch.setenv("CC", compiler)
    balance = damaged("damped", 3, boundary=SIDE)[0].balance
    assert_as_one_by_one(balance.tangent.form, balance.motion.bcs)


def test_no_compiler_is_said_once(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Kernels of FFCx may be there from before: nobody else misses it. What nobody expects is not kept quiet."""
    balance = damaged("damped", 3, boundary=SIDE)[0].balance
    monkeypatch.setattr(compiling, "_unavailable", [])
    monkeypatch.setenv("CC", "no-such-compiler")
    assert compile_simd_form(balance._work) is compile_simd_form(balance.tangent.form) is None
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1 and told[0].startswith("fracsim: note: this run takes longer")
    assert "no-such-compiler" in told[0] and told[0].endswith("install a C compiler, or name yours in CC")
    monkeypatch.setattr(simd_kernels, "SOURCE", None)
    with pytest.raises(AttributeError):
        compile_simd_form(balance._work)


def test_plain_selection_agrees(monkeypatch: pytest.MonkeyPatch) -> None:
    """DOLFINx alone gives the same forces, released forces, energy, tangent and positive moduli, to round-off."""
    results = []
    for plain in (False, True):
        selection = KernelSelection(plain=plain, min_dofs=1, min_cells=1)
        monkeypatch.setattr(terms, "KernelSelection", lambda selection=selection, **_: selection)
        balance = damaged("damped", 3, boundary=SIDE)[0].balance
        balance.set_displacement(np.random.default_rng(6).uniform(-0.2, 0.2, balance.owned_dof_count))
        stress = balance.stress
        before = [field.x.array.copy() for field in stress.damage_fields]
        for field in stress.damage_fields:
            field.x.array[::3] = 0.0
        balance.damage_changed()
        assert (balance.tangent.switch_to_blocks() is None) == plain
        balance.tangent.assemble(psd_tolerance=0.1)
        K = balance.tangent.matrix.convert("dense").getDenseArray().copy()
        released, energy = stress.assemble_released_forces(before), np.array([stress.stored_energy()])
        results.append((balance.update_forces().copy(), released, energy, K))
    for kernels, dolfinx in zip(*results, strict=True):
        assert np.abs(dolfinx).max() > 0
        np.testing.assert_allclose(kernels, dolfinx, rtol=0, atol=1e-11 * np.abs(dolfinx).max())
