"""Recorded steps are reproduced bit for bit."""

import msgspec

from tests.safety.kernel import step_vectors


def test_recorded_steps_repeat_bit_for_bit():
    recording = msgspec.json.decode(step_vectors.FILE.read_bytes(), type=step_vectors.Recording)
    safety = step_vectors.build_filter(recording)
    seen = set()
    for step in recording.steps:
        answer = step_vectors.run_step(safety, step)
        assert answer.u.tolist() == step.u
        assert (int(answer.status), answer.delta, answer.h_min) == (step.status, step.delta, step.h_min)
        seen.add(step.status)
    assert len(seen) > 1
