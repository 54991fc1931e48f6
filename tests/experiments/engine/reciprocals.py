"""A small experiment; the processes of its units import this module alone."""

from experiments.engine.experiment import Options, WorkUnit


class Reciprocals:
    """Reciprocals of small numbers, the last of which fails."""

    name = "reciprocals"
    claim = "1 / n is defined."

    def units(self, options: Options) -> list[WorkUnit]:
        return [WorkUnit(str(n), {"n": n}) for n in (2, 1, 0)]

    def run(self, parameters):
        return {"value": 1 / parameters["n"]}

    def summarize_row(self, row):
        return f"{row['value']}"

    def report(self, rows):
        return [f"{len(rows)} defined"]
