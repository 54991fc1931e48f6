"""The repetition of recorded contracts: every scene in a fixed order, and tables of both executions."""

import msgspec

from experiments.evaluation import repeated_contracts
from experiments.evaluation.repeated_contracts import METHODS, RepeatedContracts


def test_the_answers_of_the_first_methods_come_scene_by_scene_before_the_others():
    units = RepeatedContracts().units(None)
    assert len({unit.key for unit in units}) == len(units) == 5 * 160
    first = [unit.parameters["method"] for unit in units[:480]]
    assert first == list(METHODS[:3]) * 160
    assert all(len({unit.parameters["scene"] for unit in units[at : at + 3]}) == 1 for at in range(0, 480, 3))


def test_gains_and_losses_are_counted_against_the_suite():
    rows = []
    for (method, scene), old in repeated_contracts._suite_rows().items():
        if method in ("B3", "P"):
            now = msgspec.structs.replace(old, success=method == "P", h_min=-0.002 if method == "P" else 0.001)
            rows.append({"method": method, "scene": scene, "episode": msgspec.to_builtins(now)})
    text = "\n".join(RepeatedContracts().report(rows))
    assert "| B3 | 160 | 133 of 160 (77%–89%) | 0 of 160 (0%–2%) | 0 | 133 |" in text
    assert "| P | 160 | 144 of 160 (85%–94%) | 160 of 160 (98%–100%) | 16 | 0 |" in text
    assert "| P against B3 | +100.0 points [+100.0, +100.0] |" in text
    assert "| now | 160 of 320" in text
    assert "Failures now:" in text
