from experiments.planning.verdict_confusion import VerdictConfusion, confusion_table, count_verdicts

KINDS = (
    ("succeeded", True, 7),
    ("succeeded", False, 2),
    ("failed", True, 1),
    ("taken_over", False, 3),
    ("failed", False, 1),
    ("declined", False, 5),
    (None, False, 6),
)
ROWS = [{"outcome": outcome, "truth": truth} for outcome, truth, count in KINDS for _ in range(count)]


def test_every_episode_that_moved_is_counted_once():
    assert count_verdicts(ROWS) == VerdictConfusion(true_claims=7, false_claims=2, missed=1, true_failures=4)
    assert count_verdicts([*ROWS, {"error": "broke"}]) == count_verdicts(ROWS)


def test_an_outcome_check_is_judged_by_the_reports_that_it_disputes():
    rows = [{**row, "second_opinion": "agrees"} for row in ROWS]
    assert (count_verdicts(rows).disputed, count_verdicts(rows).true_disputed) == (0, 0)
    for row in rows:
        if row["outcome"] == "succeeded" and not row["truth"]:
            row["second_opinion"] = "disagrees"
    rows[0]["second_opinion"] = "disagrees"
    assert (count_verdicts(rows).disputed, count_verdicts(rows).true_disputed) == (2, 1)
    assert "disputes 2 of 2" in confusion_table(rows)[-2]


def test_the_table_shows_the_four_counts():
    text = "\n".join(confusion_table(ROWS))
    assert "| success | 7 | 2 |\n| no success | 1 | 4 |" in text
    assert "true: 7 of 9" in text
    assert "true: 4 of 5" in text
    assert "outcome check" not in text
    assert confusion_table([{"outcome": "declined", "truth": False}]) == []
