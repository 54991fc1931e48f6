"""The histogram of cyclictest, read as the summary of a variant."""

from experiments.gatekeeper.thread_timing.empty_thread import LONGEST_US, summarize_histogram

PRINTED = """# /dev/cpu_dma_latency set to 0us
# Histogram
000019 000000
000020 000600
000200 000389
000201 000007
# Total: 000000996
# Max Latencies: 120400
# Histogram Overflows: 00002
"""


def test_late_ticks_are_those_above_the_limit_also_beyond_the_histogram():
    found = summarize_histogram(PRINTED, periods=1000, late_us=200)
    assert found == {"ticks": 998, "late": 9, "skipped": 2, "p50_us": 20, "p999_us": LONGEST_US, "max_us": 120400}


def test_quantiles_are_delays_of_the_histogram():
    found = summarize_histogram(PRINTED.replace("Overflows: 00002", "Overflows: 00000"), periods=996, late_us=200)
    assert (found["p50_us"], found["p999_us"], found["late"], found["skipped"]) == (20, 201, 7, 0)
