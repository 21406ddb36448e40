"""Linear residuals of many terms, for tests of fits."""

import numpy as np

import rts

MATRIX = np.random.default_rng(5).normal(size=(12, 4, 3)).astype(np.float32)
SOLUTION = np.array([1.0, -2.0, 0.5], np.float32)


class Lines(rts.Residuals):
    """Linear residuals: term i is `MATRIX[i] (p − SOLUTION)`, `batch` terms a step in turn, plus noise of a term."""

    def __init__(self, batch=None, noise=0.0, terms=range(12)):
        self.batch, self.terms, self.loads = batch, list(terms), []
        self.noise = noise * np.random.default_rng(1).normal(size=(12, 4)).astype(np.float32)

    def __call__(self, parameters):
        raise AssertionError("each term is computed alone")

    def draw(self, step):
        if step is None or self.batch is None:
            return self.terms
        return [self.terms[(step * self.batch + i) % len(self.terms)] for i in range(self.batch)]

    def load(self, key):
        self.loads.append(key)
        return {"matrix": MATRIX[key], "goal": MATRIX[key] @ SOLUTION + self.noise[key]}

    def of(self, data):
        return Line(data)


class Line(rts.Residuals):
    """Residuals of one term of `Lines`."""

    def __init__(self, data):
        self.data = data

    def __call__(self, parameters):
        engine, known = rts.engine_of(parameters), self.data
        matrix, goal = (
            engine.constant(x, parameters["p"]) if isinstance(x, np.ndarray) else x
            for x in (known["matrix"], known["goal"])
        )
        return matrix @ parameters["p"] - goal
