"""Two-point boundary value problems as symmetric block-tridiagonal linear systems.

    [M_0 U_0      ]        M_i (2n, 2n) symmetric
    [L_0 M_1 U_1  ] y = b  L_i has one block C_i (n, n) only, in the upper right corner: it takes the second
    [    L_1 M_2 .]        half of y_i to the first half of equation i+1; U_i = L_i'
    [         .  .]

Boundary values at both ends enter as ordinary equations, so that nothing is guessed and there is no shooting.
The blocks are eliminated from both ends, with pivoting inside the blocks; where the halves meet stands the
diagonal block of the inverse. It does not know what the unknowns mean; they should be of like magnitude.
"""

from typing import NamedTuple

import numpy as np

from companion.units import Floats


class Solution(NamedTuple):
    """Solution of the system.

    Attributes
    ----------
    y : (N+1, 2n)
        Unknowns.
    inverse : (N+1, 2n, 2n)
        Diagonal blocks of the inverse of the matrix.
    """

    y: Floats
    inverse: Floats


def solve(M: Floats, C: Floats, b: Floats) -> Solution:
    """Solve a symmetric block-tridiagonal system in time and memory proportional to N.

    Parameters
    ----------
    M : (N+1, 2n, 2n)
        Diagonal blocks.
    C : (N, n, n)
        Upper right corners of the lower blocks.
    b : (N+1, 2n)
        Right-hand side.

    Returns
    -------
    Solution
        Unknowns and the diagonal blocks of the inverse.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a partial elimination is singular. For Brandin (6.4.12) none is, each being I + (a covariance) (an
        information).
    """
    n = C.shape[-1]
    ahead, rest = M[:, n:, n:].copy(), b[:, n:].copy()
    for i in range(len(C) - 1, -1, -1):  # eliminate the later blocks from the second half of block i
        W = M[i + 1].copy()
        W[n:, n:] = ahead[i + 1]
        known = np.concatenate((b[i + 1, :n], rest[i + 1]))
        X = np.linalg.solve(W, np.column_stack((np.vstack((C[i], np.zeros((n, n)))), known)))
        ahead[i] -= C[i].T @ X[:n, :n]
        rest[i] -= C[i].T @ X[:n, n]
    y, inverse = np.empty_like(b), np.empty_like(M)
    behind, first = M[0, :n, :n], b[0, :n]
    for i in range(len(M)):
        if i:  # eliminate the earlier blocks from the first half of block i
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
