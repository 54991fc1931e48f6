"""Does the loop do what the paper says? Methods, runner, metrics, statistics and verdicts of its section 7."""
