"""The interface of a two-view model: what differs between fundamental matrices, essential ones and homographies.

Layers, the optimiser and RANSAC are written once, against :class:`TwoViewModel`. A new model is one subclass and the
:class:`State` on its manifold.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Protocol, Self

import torch
from torch import Tensor

from kornia_learnnorm.geometry.constrained_fit import Fit, Loss
from kornia_learnnorm.geometry.dlt import MIN_GAP, solve_rows
from kornia_learnnorm.geometry.problem import LinearProblem


class State(Protocol):
    """Matrices of a batch as points of their manifold: a NamedTuple of tensors (B, ...)."""

    def __iter__(self) -> Any:
        """Iterate over the tensors."""

    def matrix(self) -> Tensor:
        """Return the matrices, (B, 3, 3)."""

    def retract(self, step: Tensor) -> Self:
        """Return the state after a step (B, dof)."""

    def tangents(self) -> Tensor:
        """Return the derivatives (B, 9, dof) of the matrices' column-major entries by a step."""


class Residuals(ABC):
    """What the optimiser minimises: residuals of correspondences under parameters such as the entries of a matrix."""

    components = 1  # of a correspondence's residual

    @abstractmethod
    def linearise(self, M: Tensor, x1: Tensor, x2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return residuals in the unit of the points and their derivatives by the column-major entries.

        Residuals have signs, (B, C N), all of one component before those of the next; derivatives are (B, 9, C N).
        Matrices are (B, 3, 3), points homogeneous, (B or 1, 3, N), in pixels or another unit. With weights, (B, N) of
        sum one, residuals stay smooth next to a singular point such as an epipole.
        """

    def residual(self, M: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
        """Return residuals with signs, (B, C N); arguments as for :meth:`linearise`."""
        return self.linearise(M, x1, x2)[0]

    def squares(self, residual: Tensor) -> Tensor:
        """Return the squared distances (B, N) of residuals (B, C N)."""
        if self.components == 1:
            return residual.square()
        return torch.unflatten(residual.square(), 1, (self.components, -1)).sum(1)


class TwoViewModel(Residuals):
    """What a layer, the optimiser or RANSAC must know of a matrix between two views.

    Matrices are (B, 3, 3). Methods on single correspondences take homogeneous points (B, N, 3), as the design matrix
    does, or their transposes (B, 3, N), which distances need.
    """

    name: str  # of the model in files of weights
    min_points: int  # correspondences whose design matrix has an exact null vector
    dof: int  # degrees of freedom, the size of a step on the manifold
    sample_size: int  # correspondences in a minimal sample of RANSAC
    preferred: tuple[float, ...]  # the matrix, row by row, that is chosen where the correspondences leave a choice

    # How RANSAC searches
    confidence = 0.999999  # that a sample without outliers is drawn; high, because a sample must have little noise too
    max_batch = 1024  # samples in a batch
    pool_size = 12  # best hypotheses that are kept: of a batch for local optimisation, of all for the final fit
    prescored = 512  # correspondences on which the hypotheses of a batch are scored first, if there are twice as many

    # The linear problem

    @abstractmethod
    def rows(self, x1: Tensor, x2: Tensor) -> Tensor:
        r"""Return the design matrix (B, M, 9) of correspondences (B, N, 3), :math:`M / N` rows for each."""

    def row_weights(self, weights: Tensor) -> Tensor:
        """Return the weights (B, M) of the rows of correspondences with weights (B, N)."""
        return weights

    def null_vector(self, x1: Tensor, x2: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the null vector (B, 9) of the design matrix and its relative gap (B,), see ``dlt.solve_rows``."""
        return solve_rows(self.rows(x1, x2), None if weights is None else self.row_weights(weights))

    @abstractmethod
    def carry(self, M: Tensor, T1: Tensor, T2: Tensor) -> Tensor:
        """Return the matrices for the original points, from matrices for points transformed by T1 and T2."""

    @abstractmethod
    def swap(self, M: Tensor) -> Tensor:
        """Return the matrices of the swapped views."""

    # The constraint

    @abstractmethod
    def constrain(self, M: Tensor) -> Tensor:
        """Return the nearest matrices in Frobenius norm that meet the model's constraint."""

    def needs_transforms(self, problem: LinearProblem) -> bool:
        """Return whether the solution of a problem depends on the coordinates of a normaliser."""
        return True

    def constrain_in(self, problem: LinearProblem, M: Tensor, T1: Tensor, T2: Tensor) -> Tensor:
        """Return the matrices of pixels that meet the constraint, from null matrices in the coordinates of T1, T2."""
        return self.carry(self.constrain(M), T1, T2)

    def solve_minimal(self, problem: LinearProblem) -> Tensor:
        """Return the best matrices of ``min_points`` correspondences, in the problem's coordinates."""
        return self.constrain(problem.null_matrix)

    def fallback(self, M: Tensor) -> Tensor:
        """Return the matrices of undetermined sets, with a valid one in place of any that the model excludes."""
        return M

    # Residuals

    def robust_distance(self, M: Tensor, x1: Tensor, x2: Tensor, present: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return squared distances and the factor from squared algebraic residuals to them, each (B, N).

        Points are (B, 3, N), and ``present`` is one for those that count and zero for others, (B, N). Both are features
        of the learned layers: next to a singular point they stay moderate.
        """
        squares = self.squares(self.residual(M, x1, x2))
        return squares, torch.ones_like(squares)

    # The manifold

    @abstractmethod
    def state(self, M: Tensor) -> State:
        """Return the nearest points of the manifold to matrices (B, 3, 3)."""

    # RANSAC: many matrices of the correspondences of one pair

    def solve_samples(self, x1: Tensor, x2: Tensor, shift: float) -> Tensor:
        """Return the matrices (M, 3, 3) of the non-degenerate minimal samples (K, S, 3), any number of each.

        Samples that a shift of a point by less than ``shift`` pixels makes degenerate are dropped.
        """
        h, gap = self.null_vector(x1, x2, None)
        return self.constrain(torch.unflatten(h[gap > MIN_GAP], -1, (3, 3)))

    def score_terms(self, x1: Tensor, x2: Tensor) -> Tensor:
        """Return what :meth:`score_squares` needs of the correspondences (3, N) of a pair, (T, N)."""
        return torch.cat([x1, x2])

    def score_squares(self, M: Tensor, terms: Tensor, threshold: float) -> Tensor:
        """Return the squares (K, N) of distances over a threshold, of all correspondences under matrices (K, 3, 3)."""
        return self.squares(self.residual(M, terms[None, :3], terms[None, 3:]) / threshold)

    def reweighted_fit(self, x1: Tensor, x2: Tensor, M: Tensor, losses: Sequence[Loss]) -> Fit | None:
        """Return matrices (K, 3, 3) after a step of reweighted least squares for each loss, if the model has any.

        Homogeneous points (3, N) are shared by all matrices; losses are those of squared distances.
        """
        return None

    def is_degenerate(self, state: Any) -> Tensor:
        """Return which states are limits of the manifold rather than matrices of the model, (B,) bool."""
        return torch.zeros(len(state.matrix()), dtype=torch.bool)
