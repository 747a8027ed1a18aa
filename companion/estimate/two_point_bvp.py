"""Two-point boundary problems as what they are: symmetric block-tridiagonal linear systems.

    [M_0 U_0      ]        M_i (2n, 2n) symmetric
    [L_0 M_1 U_1  ] y = b  L_i has one block C_i (n, n) only, in the upper right corner: it takes the second
    [    L_1 M_2 .]        half of y_i to the first half of equation i+1; U_i = L_i'
    [         .  .]

Boundary values at both ends enter like any other equation, so that nothing is guessed and nothing "shot".
Eliminated block by block from both ends, pivoting inside the blocks: where the halves meet stands the
diagonal block of the inverse. It does not know what the unknowns mean; they should be of like magnitude.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class Solution(NamedTuple):
    """y (N+1, 2n) and the diagonal blocks (N+1, 2n, 2n) of the inverse of the matrix."""

    y: Array
    inverse: Array


def solve(M: Array, C: Array, b: Array) -> Solution:
    """Solve for M (N+1, 2n, 2n), C (N, n, n), b (N+1, 2n), in time and memory proportional to N.

    numpy.linalg.LinAlgError where a partial elimination is singular; for (6.4.12) none is, each being
    I + (a covariance) (an information).
    """
    n = C.shape[-1]
    ahead, rest = M[:, n:, n:].copy(), b[:, n:].copy()
    for i in range(len(C) - 1, -1, -1):  # what the later blocks say about the second half of block i
        W = M[i + 1].copy()
        W[n:, n:] = ahead[i + 1]
        known = np.concatenate((b[i + 1, :n], rest[i + 1]))
        X = np.linalg.solve(W, np.column_stack((np.vstack((C[i], np.zeros((n, n)))), known)))
        ahead[i] -= C[i].T @ X[:n, :n]
        rest[i] -= C[i].T @ X[:n, n]
    y, inverse = np.empty_like(b), np.empty_like(M)
    behind, first = M[0, :n, :n], b[0, :n]
    for i in range(len(M)):
        if i:  # what the earlier blocks say about the first half of block i
            W = M[i - 1].copy()
            W[:n, :n] = behind
            known = np.concatenate((first, b[i - 1, n:]))
            X = np.linalg.solve(W, np.column_stack((np.vstack((np.zeros((n, n)), C[i - 1].T)), known)))
            behind = M[i, :n, :n] - C[i - 1] @ X[n:, :n]
            first = b[i, :n] - C[i - 1] @ X[n:, n]
        W = M[i].copy()
        W[:n, :n], W[n:, n:] = behind, ahead[i]
        V = np.linalg.inv(W)
        inverse[i] = 0.5 * (V + V.T)
        y[i] = V @ np.concatenate((first, rest[i]))
    return Solution(y, inverse)
