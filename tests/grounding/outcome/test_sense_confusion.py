"""Confusion matrices of the senses from result rows."""

import msgspec

from dualbrain.evaluation.analysis.sense_confusion import confirmed_success_confusion, sense_confusions
from dualbrain.records import Violation
from tests.evaluation.sample_rows import episode_row

BROKEN = (Violation(kind="force_fragile", start=0.0, duration=0.1, peak=60.0, bodies=("clear_glass", "finger")),)


def row(*, success, fulfilled, intact="confirmed", **fields):
    return msgspec.structs.replace(
        episode_row(), success=success, sense_fulfilled=fulfilled, sense_intact=intact, claimed=True, **fields
    )


ROWS = [
    row(success=True, fulfilled="confirmed", second_opinion="agrees"),
    row(success=True, fulfilled="not judged", second_opinion="none"),
    row(success=False, fulfilled="confirmed", intact="contradicted", violations=BROKEN, second_opinion="disagrees"),
    row(success=False, fulfilled="contradicted", second_opinion="disagrees"),
    row(success=False, fulfilled="confirmed", second_opinion="agrees", judged=False),
]


def test_each_sense_is_compared_with_its_fact():
    by_name = {one.sense: one for one in sense_confusions(ROWS)}
    fulfilled, intact = by_name["fulfilled"], by_name["intact"]
    assert (fulfilled.confirmed_true, fulfilled.confirmed_false) == (1, 1)
    assert (fulfilled.contradicted_true, fulfilled.contradicted_false, fulfilled.not_judged) == (0, 1, 1)
    assert (intact.confirmed_true, intact.contradicted_false, intact.confirmed_false) == (3, 1, 0)
    assert by_name["placed"].confirmed_true == 0  # older rows have no verdict


def test_the_combined_check_counts_claims():
    one = confirmed_success_confusion(ROWS)
    assert (one.confirmed_true, one.confirmed_false, one.contradicted_false, one.not_judged) == (1, 0, 2, 1)
