"""The user's energy, criterion, law of an edge and terms, made, and checked as the tests check the built-in ones.

A check evaluates the object at a few deformations or stresses. Its message names the object, what is wrong, and what is
needed (docs/python.md#checks).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc
from mpi4py import MPI
from petsc4py import PETSc

from ..errors import InputError
from ..forms.energies import Energy, UserEnergy
from ..fracture.fracture_pass import EdgeLaw
from ..mechanics.balance import Balance
from ..mechanics.jit import cell_measure, compile_form, point_expression
from ..mechanics.material_fields import MaterialFields
from ..mechanics.matrix_assembly import VectorAssembler
from ..mechanics.term import Term, overriding
from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from ..study.plugins import PhysicsPart

if TYPE_CHECKING:
    from .terms import TermInputs

Values = npt.NDArray[np.float64]

# Relative error of what is exact but for round-off, and of differences with steps of eps^(1/3).
EXACT, DIFFERENCE = 1e-9, 1e-6
# cells of a rank at which an energy is checked
CHECKED_CELLS = 200


# --- energy ---


def user_energy(part: PhysicsPart, domain: Domain) -> Callable[[Any, Any], Energy]:
    """Return a function of mu and lambda, as UFL coefficients in Pa, that makes the energy. Raises InputError."""

    def make(mu: Any, lmbda: Any) -> Energy:
        is_factory = isinstance(part.value, type) or (callable(part.value) and not hasattr(part.value, "psi"))
        law = part.make(is_factory=is_factory, mu=mu, lmbda=lmbda, mesh=domain.mesh)
        if not callable(getattr(law, "psi", None)):
            raise InputError(f"{part.label} has no method psi(F), which returns the energy density in J/m^3")
        return UserEnergy(mu, lmbda, law=law)

    return make


class _SampledEnergy:
    """psi (J/m^3), P (Pa) and moduli dP/dF (Pa) of an energy at some cells, for the same F in all of them."""

    def __init__(self, energy: Energy, domain: Domain) -> None:
        """Compile the energy and its derivatives (collective)."""
        self.dim = d = domain.dim
        self._F = fem.Constant(domain.mesh, np.eye(d))
        F = ufl.variable(self._F)
        psi = energy.psi(F)
        if psi.ufl_shape:
            raise ValueError(f"psi(F) has the shape {psi.ufl_shape}; a scalar is needed")
        P = ufl.diff(psi, F)
        A = ufl.diff(P, F)
        index = [(i, j) for i in range(d) for j in range(d)]
        entries = [psi, *(P[i, j] for i, j in index), *(A[i, j, m, n] for i, j in index for m, n in index)]
        self._expression = point_expression(domain, ufl.as_vector(entries))
        self._cells = np.arange(min(domain.cell_count, CHECKED_CELLS), dtype=np.int32)

    def __call__(self, F: Values) -> tuple[Values, Values, Values]:
        """Return psi (n,), P (n, d, d) and moduli (n, d, d, d, d)."""
        self._F.value[...] = F
        d = self.dim
        rows = self._expression.evaluate_at_points(self._cells).reshape(-1, 1 + d**2 + d**4)
        return rows[:, 0], rows[:, 1 : 1 + d**2].reshape(-1, d, d), rows[:, 1 + d**2 :].reshape(-1, d, d, d, d)


def check_energy(part: PhysicsPart, material: MaterialFields, domain: Domain) -> None:
    """Check the energy of a material at rest and at a few deformations (collective). Raises InputError."""
    try:
        sampled = _SampledEnergy(material.energy, domain)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{part.label}: psi(F) cannot be compiled: {type(error).__name__}: {error}") from error
    wrong = _energy_fault(
        sampled, *(np.broadcast_to(value, domain.cell_count)[:CHECKED_CELLS] for value in (material.mu, material.lmbda))
    )
    # the message of the lowest rank that has one
    messages = [message for message in domain.comm.allgather(wrong) if message]
    if messages:
        raise InputError(f"{part.label} {messages[0]}")


def _energy_fault(sampled: _SampledEnergy, mu: Values, lmbda: Values) -> str:
    """Return what is wrong with an energy that is to have mu and lambda (cells,), Pa, at rest; empty: nothing."""
    if not len(mu):
        return ""
    psi, P, A = sampled(np.eye(sampled.dim))
    repeated = len(psi) // len(mu)
    mu, lmbda = np.repeat(mu, repeated), np.repeat(lmbda, repeated)
    modulus = 2 * mu + np.abs(lmbda)
    if not all(np.isfinite(values).all() for values in (psi, P, A)):
        return "is not finite at rest (F = I)"
    if (worst := np.max(np.abs(psi) / modulus)) > EXACT:
        return f"has psi(I) = {psi[np.argmax(np.abs(psi))]:.4g} J/m^3, {worst:.2g} of its modulus: subtract psi(I)"
    if np.max(np.abs(P) / modulus[:, None, None]) > EXACT:
        return f"has a stress at rest, P(I) = {P[np.argmax(np.abs(P).max(axis=(1, 2)))].tolist()} Pa; 0 is needed"
    return _moduli_fault(A, mu, lmbda) or _deformed_fault(sampled, modulus)


def _moduli_fault(A: Values, mu: Values, lmbda: Values) -> str:
    """Return what is wrong with the moduli (n, d, d, d, d) at rest; empty: they are Hooke's law."""
    d, identity = A.shape[1], np.eye(A.shape[1])
    shear = np.einsum("ik,jl->ijkl", identity, identity) + np.einsum("il,jk->ijkl", identity, identity)
    volume = np.einsum("ij,kl->ijkl", identity, identity)
    # of mu shear + lambda volume
    own_mu, own_lmbda = A[:, 0, 1, 0, 1], A[:, 0, 0, 1, 1]
    fitted = own_mu[:, None, None, None, None] * shear + own_lmbda[:, None, None, None, None] * volume
    scale = np.max(np.abs(A))
    if np.max(np.abs(A - fitted)) > DIFFERENCE * scale:
        return "is not isotropic at rest, and contact, damping and cracks are those of an isotropic body"
    eigenvalues = float(np.min(own_mu)), float(np.min(2 * own_mu + d * own_lmbda))
    if min(eigenvalues) <= 0:
        return (
            f"is not positive definite at rest: 2 mu = {2 * eigenvalues[0]:.4g} Pa, 2 mu + {d} lambda = "
            f"{eigenvalues[1]:.4g} Pa"
        )
    worst = int(np.argmax(np.abs(own_mu - mu) + np.abs(own_lmbda - lmbda)))
    if abs(own_mu[worst] - mu[worst]) + abs(own_lmbda[worst] - lmbda[worst]) > DIFFERENCE * scale:
        (young, poisson), (own_young, own_poisson) = (
            (m * (3 * lame + 2 * m) / (lame + m), lame / (2 * (lame + m)))
            for m, lame in ((mu[worst], lmbda[worst]), (own_mu[worst], own_lmbda[worst]))
        )
        return (
            f"has E = {own_young:.6g} Pa and nu = {own_poisson:.6g} at rest, and [material] has young = {young:.6g} "
            f"and poisson = {poisson:.6g}: give these values there, or make the energy of its arguments mu and lmbda"
        )
    return ""


def _deformed_fault(sampled: _SampledEnergy, modulus: Values) -> str:
    """Return what is wrong with an energy at deformations of some 20 %; empty: nothing."""
    random = np.random.default_rng(1)
    for _ in range(3):
        F = np.eye(sampled.dim) + random.uniform(-0.1, 0.1, (sampled.dim, sampled.dim))
        H = random.uniform(-1, 1, F.shape)
        psi, P, A = sampled(F)
        if not all(np.isfinite(values).all() for values in (psi, P, A)):
            return f"is not finite at F = {F.round(3).tolist()}"
        turned, _, _ = sampled(_rotation(sampled.dim, random) @ F)
        if np.max(np.abs(turned - psi) / modulus) > EXACT:
            return (
                "is not objective: psi(Q F) differs from psi(F) for a rotation Q; use F.T * F, its invariants or det(F)"
            )
        t = np.finfo(float).eps ** (1 / 3)
        (ahead, P_ahead, _), (behind, P_behind, _) = sampled(F + t * H), sampled(F - t * H)
        slope = np.einsum("nij,ij->n", P, H) - (ahead - behind) / (2 * t)
        change = np.einsum("nijkl,kl->nij", A, H) - (P_ahead - P_behind) / (2 * t)
        if max(np.max(np.abs(slope) / modulus), np.max(np.abs(change) / modulus[:, None, None])) > 100 * DIFFERENCE:
            return "has derivatives that are not those of psi (differences of psi and P say otherwise): is it smooth?"
    return ""


def _rotation(dim: int, random: np.random.Generator) -> Values:
    """Return a random rotation matrix (d, d)."""
    Q, R = np.linalg.qr(random.normal(size=(dim, dim)))
    Q = Q * np.sign(np.diag(R))
    if np.linalg.det(Q) < 0:
        Q[:, 0] = -Q[:, 0]
    return np.asarray(Q)


# --- criterion and law of an edge ---


def user_criterion(part: PhysicsPart, dim: int) -> Callable[[Values, Values, Values], Values]:
    """Return the function load(stress, edges, strength) of a criterion, checked. Raises InputError."""
    load = part.make()
    if not callable(load):
        raise InputError(f"{part.label} is no function load(stress, edges, strength)")
    random, n, k = np.random.default_rng(2), 20, dim * (dim + 1) // 2
    stress = random.normal(size=(n, dim, dim))
    stress = stress + stress.transpose(0, 2, 1)
    edges = random.normal(size=(n, k, dim))
    edges /= np.linalg.norm(edges, axis=2, keepdims=True)
    evaluate = partial(_evaluate_load, part, load)
    strength = np.ones((n, k))
    loads = evaluate(stress, edges, strength)
    if np.any(evaluate(np.zeros_like(stress), edges, strength) >= 1):
        raise InputError(f"{part.label} breaks edges without stress: the load must be below 1 there")
    if np.any(evaluate(stress, edges, np.full((n, k), np.inf)) >= 1):
        raise InputError(f"{part.label} breaks edges of infinite strength, which never break: divide by the strength")
    Q = _rotation(dim, random)
    turned = evaluate(Q @ stress @ Q.T, edges @ Q.T, strength)
    if not np.allclose(turned, loads, rtol=EXACT, atol=EXACT):
        raise InputError(f"{part.label} is not objective: the load changes if stress and edges turn together")
    senses = random.choice([-1.0, 1.0], (n, k, 1))
    if not np.allclose(evaluate(stress, senses * edges, strength), loads, rtol=EXACT, atol=EXACT):
        raise InputError(f"{part.label} depends on the sense of an edge: +n and -n are the same edge")
    return evaluate


def _evaluate_load(part: PhysicsPart, load: Any, stress: Values, edges: Values, strength: Values) -> Values:
    """Return the loads (n, k) of a criterion. Raises InputError for another shape, or values that are no numbers."""
    values = np.asarray(load(stress, edges, strength), float)
    if values.shape != strength.shape:
        raise InputError(
            f"{part.label} returns the shape {values.shape} for stress {stress.shape} and edges {edges.shape}; a load "
            f"for each edge is needed, {strength.shape}"
        )
    if np.isnan(values).any():
        raise InputError(f"{part.label} returns loads that are no numbers (nan)")
    return values


class _UserEdgeLaw:
    """Law of an edge as a function of the user. Ranks agree on integrities between 0 and 1."""

    all_or_nothing = False

    def __init__(self, law: Callable[[Values], Values]) -> None:
        self._law = law

    def __call__(self, load: Values) -> Values:
        """Return the integrity (n,) under loads (n,)."""
        return np.asarray(self._law(load), float)


def user_edge_law(part: PhysicsPart) -> EdgeLaw:
    """Return the law of an edge, checked. Raises InputError."""
    law = part.make()
    if not callable(law):
        raise InputError(f"{part.label} is no function of the load that returns the integrity")
    result = _UserEdgeLaw(law)
    loads = np.array([1.0, 1.01, 1.2, 1.5, 2.0, 5.0, 1e3, 1e6])
    integrity = result(loads)
    if integrity.shape != loads.shape:
        raise InputError(f"{part.label} returns the shape {integrity.shape} for {loads.shape} loads")
    if not np.all((integrity >= 0) & (integrity <= 1)):
        raise InputError(f"{part.label} returns integrities outside 0 to 1: {integrity.tolist()} for {loads.tolist()}")
    if np.any(np.diff(integrity) > 0):
        raise InputError(f"{part.label} rises with the load: an edge that is loaded more must not keep more")
    if integrity[-1] > 0:
        raise InputError(f"{part.label} never breaks an edge: the integrity must reach 0 at a finite load")
    return result


# --- terms of the balance -------------------------------------------------------------------------------------------


def user_terms(parts: Sequence[PhysicsPart], inputs: TermInputs) -> list[tuple[PhysicsPart, Term]]:
    """Return the terms that the user's classes or functions make of the inputs. Raises InputError."""
    result = []
    for part in parts:
        terms = part.make(inputs, is_factory=True)
        for term in terms if isinstance(terms, list | tuple) else [terms]:
            if not isinstance(term, Term):
                raise InputError(f"{part.label} makes a {type(term).__name__}; a fracsim.Term or a list is needed")
            _check_forms(part, term, inputs)
            result.append((part, term))
    return result


def _check_forms(part: PhysicsPart, term: Term, inputs: TermInputs) -> None:
    """Raise InputError unless the forms of a term can be written and compiled (collective)."""
    space, dx = inputs.domain.space, cell_measure(inputs.domain)
    v, w = fem.Function(space), ufl.TestFunction(space)
    try:
        for form in (term.virtual_work(w, dx), term.tangent_form(v, w, dx)):
            if not isinstance(form, int):
                compile_form(form)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{part.label}: its forms cannot be compiled: {type(error).__name__}: {error}") from error


class TermCheck:
    """Compares the derivatives of terms with differences, at a small displacement without symmetry."""

    def __init__(self, balance: Balance) -> None:
        """Prepare displacements of the body (collective)."""
        self._balance, self._domain = balance, balance.domain
        self._assembler = VectorAssembler(balance.domain)
        self._direction = fem.Function(balance.domain.space)

    def __call__(self, part: PhysicsPart, term: Term) -> None:
        """Check a term (collective). Raises InputError that names it."""
        balance, t = self._balance, 1e-4
        start = balance.u.x.array[: balance.owned_dof_count].copy()
        base, H, G = 1e-3 * self._wave(1), self._wave(2), self._wave(3)
        forces = self._forces_of(term)
        tangent = self._tangent_of(term) if balance.scheme.implicit else None
        moved = []
        for step in (t, -t):
            balance.set_displacement(base + step * H)
            moved.append((forces(), term.potential()))
        balance.set_displacement(base)
        (ahead, potential_ahead), (behind, potential_behind) = moved
        difference, at_base = np.asarray((ahead - behind) / (2 * t), float), forces()
        wrong = ""
        if not self._all(np.isfinite(difference)):
            wrong = "has forces that are not finite"
        elif tangent is not None and not self._near(tangent(H), difference):
            wrong = "has a tangent that is not the derivative of its forces"
        elif tangent is not None and term.symmetric and not self._near_sums(G @ tangent(H), H @ tangent(G)):
            wrong = "has a tangent that is not symmetric: set symmetric = False"
        elif potential_ahead is not None and potential_behind is not None:
            slope = (potential_ahead - potential_behind) / (2 * t)
            if not self._near_sums(slope, at_base @ H):
                wrong = "has a potential whose derivative is not its force"
        balance.set_displacement(start)
        if wrong:
            raise InputError(f"{part.label} {wrong}")

    def _wave(self, number: int) -> Values:
        """(owned dofs,) displacement of the size of a cell, m: the same at any number of ranks."""
        domain = self._domain
        X = (domain.nodes[: domain.node_count] - domain.bounds.lower) / domain.bounds.diagonal
        phase = X @ np.arange(1, domain.dim + 1) + number
        return domain.mean_edge_length * np.stack(
            [np.sin((axis + 2) * phase + axis) for axis in range(domain.dim)], axis=1
        ).reshape(-1)

    def _forces_of(self, term: Term) -> Callable[[], Values]:
        """Return a function that returns the term's part (owned dofs,) of r, N, at the current u (collective)."""
        work = term.virtual_work(ufl.TestFunction(self._domain.space), cell_measure(self._domain))
        form = None if isinstance(work, int) else compile_form(work)

        def forces() -> Values:
            r = np.zeros(self._balance.owned_dof_count) if form is None else self._assembler(form)
            term.add_nodal_forces(r)
            a = term.acceleration()
            return r if a is None else np.asarray(r + self._balance.mass.multiply(a))

        return forces

    def _tangent_of(self, term: Term) -> Callable[[Values], Values]:
        """Return a function that returns the term's tangent at the current u times a displacement (collective)."""
        w, dx = ufl.TestFunction(self._domain.space), cell_measure(self._domain)
        moduli = term.tangent_form(self._direction, w, dx)
        form = None if isinstance(moduli, int) else compile_form(moduli)

        def product(displacement: Values) -> Values:
            self._direction.x.array[: len(displacement)] = displacement
            self._direction.x.scatter_forward()
            result = np.zeros(len(displacement)) if form is None else self._assembler(form)
            for K in self._matrices(term):
                x, y = K.createVecs()
                x.array_w[:] = displacement
                K.mult(x, y)
                result += y.array_r
            return np.asarray(result + self._balance.mass.multiply(term.mass_factor * displacement))

        return product

    def _matrices(self, term: Term) -> list[PETSc.Mat]:
        """Return the matrices of forces on nodes (collective)."""
        matrices, space = [], self._domain.space
        v, w = ufl.TrialFunction(space), ufl.TestFunction(space)
        if overriding([term], "add_stiffness"):
            K = fem_petsc.assemble_matrix(fem.form(ufl.inner(ufl.grad(v), ufl.grad(w)) * cell_measure(self._domain)))
            K.assemble()
            K.zeroEntries()
            term.add_stiffness(K)
            K.assemble()
            matrices.append(K)
        coupling = term.coupling_matrix()
        if isinstance(coupling, PETSc.Mat):
            matrices.append(coupling)
        return matrices

    def _all(self, flags: npt.NDArray[np.bool_]) -> bool:
        return bool(self._domain.comm.allreduce(bool(flags.all()), op=MPI.LAND))

    def _near(self, values: Values, expected: Values) -> bool:
        """Return whether two vectors agree to the error of differences, relative to the larger (collective)."""
        comm = self._domain.comm
        scale = comm.allreduce(max(np.abs(values).max(initial=0.0), np.abs(expected).max(initial=0.0)), op=MPI.MAX)
        error = comm.allreduce(np.abs(values - expected).max(initial=0.0), op=MPI.MAX)
        return bool(error <= 100 * DIFFERENCE * scale)

    def _near_sums(self, value: Any, expected: Any) -> bool:
        """Return whether two parts agree when they are summed over the ranks (collective)."""
        first, second = sum_over_ranks(self._domain.comm, np.array([value, expected], float))
        return bool(abs(first - second) <= 100 * DIFFERENCE * max(abs(first), abs(second)))
