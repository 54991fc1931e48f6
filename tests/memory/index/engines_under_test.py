"""A vector engine in RAM that searches exactly, counts its searches, and can stop answering."""

import numpy as np

from dualbrain.memory.index.engines.engine import EngineUnreachableError


class NumpyEngine:
    """See `VectorEngine`."""

    max_count = 2**31

    def __init__(self):
        self.vectors = {}
        self.answers = True
        self.searched = []

    def _require_answer(self):
        if not self.answers:
            self.refuse()

    def refuse(self, *_):
        raise EngineUnreachableError("switched off by the test")

    def stored(self):
        self._require_answer()
        pairs = np.array(list(self.vectors), np.int64).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]

    def add(self, seqs, groups, vectors):
        self._require_answer()
        for seq, group, vector in zip(seqs.tolist(), groups.tolist(), vectors, strict=True):
            self.vectors.setdefault((seq, group), vector.copy())

    def nearest(self, group, vector, count):
        self._require_answer()
        self.searched.append(count)
        seqs = np.array([seq for seq, other in self.vectors if other == group], np.int64)
        rows = np.array([row for (_, other), row in self.vectors.items() if other == group], np.float32)
        products = rows.reshape(len(seqs), len(vector)) @ vector
        best = np.argsort(-products, kind="stable")[:count]
        return seqs[best], products[best]

    def close(self):
        pass
