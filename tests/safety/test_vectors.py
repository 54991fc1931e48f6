"""Recorded steps come out bit for bit."""

import msgspec

from tests.safety import vectors


def test_recorded_steps_repeat_bit_for_bit():
    recording = msgspec.json.decode(vectors.FILE.read_bytes(), type=vectors.Recording)
    safety = vectors.build(recording)
    seen = set()
    for step in recording.steps:
        answer = vectors.take(safety, step)
        assert answer.u.tolist() == step.u
        assert (int(answer.status), answer.delta, answer.h_min) == (step.status, step.delta, step.h_min)
        seen.add(step.status)
    assert len(seen) > 1
