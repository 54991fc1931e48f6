"""Reference implementation of the dual method of Goldfarb and Idnani, with least squares instead of factorisations.

It takes the same steps as the kernel: the next constraint, the removed constraint, the number of iterations. A mistake
that only costs iterations is therefore detected, too.
"""

import numpy as np

TOLERANCE, DEPENDENCE_TOLERANCE, MAX_ITERATIONS = 1e-11, 1e-9, 80
"""Tolerance of a satisfied row; sine of the angle below which a normal depends on others; most iterations."""


class ReferenceQP:
    """min ½|x|², u = u_nom + S x, A u + soft·slack ≥ b, low ≤ u ≤ high; constraint order: lower, upper, rows."""

    def __init__(self, S, A, b, soft, low, high, u_nom, *, slack):
        self.S, self.A, self.b, self.soft, self.low, self.high = S, A, b, soft, low, high
        self.n, self.u_nom, self.with_slack = len(u_nom), u_nom, slack
        self.u, self.slack, self.iterations = u_nom.copy(), 0.0, 0
        self.active, self.multiplier = [], np.zeros(0)

    def normal(self, at):
        """The normal of a constraint in coordinates (x, slack)."""
        n = self.n
        if at < 2 * n:
            inner, own = self.S[at % n] * (1.0 if at < n else -1.0), 0.0
        else:
            inner, own = self.S.T @ self.A[at - 2 * n], self.soft[at - 2 * n]
        return np.array([*inner, own] if self.with_slack else inner)

    def constraint_values(self, u, slack):
        """Constraint values minus right-hand sides."""
        rows = self.A @ u - self.b + (self.soft * slack if self.with_slack else 0.0)
        return np.concatenate([u - self.low, self.high - u, rows])

    def step(self, x):
        self.u = self.u + self.S @ x[: self.n]
        self.slack += x[self.n] if self.with_slack else 0.0

    def warm_start(self, warm):
        """Start from the minimiser on `warm`, without constraints whose multipliers are not positive."""
        for at in warm[: self.n]:
            if self.is_independent(at):
                self.active.append(at)
        while self.active:
            N = np.array([self.normal(at) for at in self.active])
            self.multiplier = np.linalg.solve(N @ N.T, -self.constraint_values(self.u_nom, 0.0)[self.active])
            if self.multiplier.min() > 0.0:
                self.step(N.T @ self.multiplier)
                return
            del self.active[int(np.argmin(self.multiplier))]
        self.multiplier = np.zeros(0)

    def decompose(self, at):
        """Coefficients of a normal in the active normals, and the remainder."""
        normal = self.normal(at)
        if not self.active:
            return np.zeros(0), normal
        N = np.array([self.normal(other) for other in self.active])
        r = np.linalg.lstsq(N.T, normal, rcond=None)[0]
        return r, normal - N.T @ r

    def is_independent(self, at):
        _, rest = self.decompose(at)
        return rest @ rest > DEPENDENCE_TOLERANCE**2 * (self.normal(at) @ self.normal(at))

    def solve(self, warm=()):
        """0: solved; 1: infeasible (active and multiplier are a Farkas certificate); 2: iteration limit."""
        self.warm_start(list(warm))
        while self.iterations < MAX_ITERATIONS:
            values = self.constraint_values(self.u, self.slack)
            at = int(np.argmin(values))
            if not values[at] < -TOLERANCE:
                return 0
            result = self.add_constraint(at)
            if result:
                return result
        return 2

    def add_constraint(self, at):
        """Bring one violated constraint to its bound."""
        mine = 0.0
        while self.iterations < MAX_ITERATIONS:
            r, rest = self.decompose(at)
            ratios = np.where(r > 1e-13, self.multiplier / np.where(r > 1e-13, r, 1.0), np.inf)
            dual = ratios.min(initial=np.inf)
            room = len(self.active) < len(rest) and self.is_independent(at)
            primal = -self.constraint_values(self.u, self.slack)[at] / (rest @ rest) if room else np.inf
            if np.isinf(dual) and np.isinf(primal):
                self.active, self.multiplier = [*self.active, at], np.array([*(-r), 1.0])
                return 1
            step = min(dual, primal)
            if room:
                self.step(step * rest)
            self.multiplier, mine = self.multiplier - step * r, mine + step
            self.iterations += 1
            if primal <= dual:
                self.active.append(at)
                self.multiplier = np.array([*self.multiplier, mine])
                return 0
            gone = int(np.argmin(ratios))
            del self.active[gone]
            self.multiplier = np.delete(self.multiplier, gone)
        return 2
