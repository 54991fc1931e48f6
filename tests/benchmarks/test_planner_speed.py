"""The report of the comparison of plans before and after a change."""

from collections import Counter

from benchmarks.planner_speed.before_after import report, rotated


def one_answer(seconds, text, *, right, new=200):
    timings = {"prefill": 0.6 * seconds, "decode": 0.4 * seconds, "prompt_tokens": 900.0, "output_tokens": 80.0}
    return {"text": text, "right": right, "s": seconds, "timings": timings | {"cached_tokens": 900.0 - new}}


def rows(pairs):
    return [
        {"before": one_answer(before, "a", right=True, new=600), "after": one_answer(after, text, right=text == "a")}
        for before, after, text in pairs
    ]


def test_ratios_are_those_of_each_question():
    lines = report(rows([(10.0, 5.0, "a"), (20.0, 8.0, "b"), (2.0, 2.0, "a")]))
    before, after = (line for line in lines if line.startswith(("| before", "| after")))
    assert [cell.strip() for cell in before.split("|")][2:7] == ["10.0", "6.0", "4.0", "600", "80"]
    assert [cell.strip() for cell in after.split("|")][2:7] == ["5.0", "3.0", "2.0", "200", "80"]
    assert "3 of 3" in before
    assert "2 of 3" in after
    assert "median ratio 0.50 (95 % interval 0.40 to 1.00), ratio of the sums 0.47; 2 equal answers" in lines[-1]


def test_no_rows_are_no_result():
    assert report([]) == ["no answers"]


def test_the_variant_with_more_threads_has_a_ratio_of_its_own():
    with_served = [row | {"served": one_answer(4.0, "a", right=True)} for row in rows([(10.0, 5.0, "a")] * 2)]
    assert [line.partition(":")[0] for line in report(with_served)[-2:]] == ["after", "served"]
    assert "median ratio 0.40 (95 % interval 0.40 to 0.40), ratio of the sums 0.40" in report(with_served)[-1]


def test_each_variant_has_each_position_equally_often():
    orders = [rotated(("before", "after", "served"), number) for number in range(6)]
    assert all(Counter(at) == {"before": 2, "after": 2, "served": 2} for at in zip(*orders, strict=True))
