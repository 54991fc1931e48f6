from proofs.crew import carry_out
from proofs.proof import Unit

CATALOGUE = "tests.benchmarks.small_proofs"


def rows(units, jobs=2):
    return {row["key"]: row for row in carry_out("doubling", units, jobs, 0, CATALOGUE)}


def test_every_unit_is_done_once_and_what_breaks_or_dies_costs_only_itself():
    units = [
        Unit("zero", {"n": 0}),
        Unit("dead", {"n": 1, "die": True}),
        *(Unit(str(n), {"n": n}) for n in range(1, 6)),
    ]
    done = rows(units)
    assert set(done) == {unit.key for unit in units}
    assert {done[str(n)]["double"] for n in range(1, 6)} == {2, 4, 6, 8, 10}
    assert done["zero"]["error"].startswith("ZeroDivisionError")
    assert done["dead"] == {"key": "dead", "error": "the worker died with exit code 9"}
    assert all(row["wall_s"] >= 0.0 for key, row in done.items() if key != "dead")


def test_nothing_to_do_starts_nobody():
    assert rows([]) == {}
