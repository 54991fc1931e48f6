"""Ten million fuzzed frames and contracts at the door: nothing raises, nothing grows."""

from __future__ import annotations

import resource
import time
from typing import Any

import msgspec
import numpy as np

from dualbrain.runtime.gatekeeper.frames import Broken, Decoder, encode
from dualbrain.runtime.gatekeeper.messages import UPWARD, Heartbeat, Operate, Propose, encode_body, kind_of, read
from proofs.proof import Options, Row, Unit

FRAMES = 10_000_000
A_UNIT = 250_000


class FuzzSocket:
    """Whatever comes through the door is a message or a refusal."""

    name = "fuzz_socket"
    claim = "10⁷ fuzzed frames and contracts are each a message or a refusal; nothing raises, memory does not grow."

    def units(self, options: Options) -> list[Unit]:
        """By seed."""
        del options
        return [Unit(f"seed {seed}", {"seed": seed}) for seed in range(FRAMES // A_UNIT)]

    def run(self, about: dict[str, Any]) -> Row:
        """Valid frames with bytes changed, cut, doubled; and pure noise."""
        rng = np.random.default_rng([about["seed"], 11])
        samples = [(kind_of(one), encode_body(one)) for one in _samples()]
        counts = {"messages": 0, "refused": 0, "broken": 0}
        _some(rng, samples, 2000, counts)
        before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
        _some(rng, samples, A_UNIT, counts)
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        return {**counts, "frames": A_UNIT, "grown_kib": grown, "seconds": time.monotonic() - start}

    def brief(self, row: Row) -> str:
        """For the progress line."""
        return f"{row['frames']} frames, {row['messages']} messages, grown by {row['grown_kib']} KiB"

    def report(self, rows: list[Row]) -> list[str]:
        """The sum."""
        total = {name: sum(row[name] for row in rows) for name in ("frames", "messages", "refused", "broken")}
        most, spent = max(row["grown_kib"] for row in rows), sum(row["seconds"] for row in rows)
        return [
            f"{total['frames']:,} frames: {total['messages']:,} were messages, {total['refused']:,} were refused, "
            f"{total['broken']:,} broke their stream; none raised. Most growth of a process within "
            f"{A_UNIT:,} frames: {most} KiB. {1e6 * spent / total['frames']:.1f} µs a frame."
        ]


def _samples():
    return [
        Heartbeat(), Operate(act="pause"), Operate(act="speed", speed=0.1),
        Propose(contract=b'{"id":"c"}', issued=0.0, expires=1.0, scene_version=1, seal=b"0" * 32),
        *(kind() for kind in UPWARD if not msgspec.structs.fields(kind)),
    ]  # fmt: skip


def _some(rng: np.random.Generator, samples: list[tuple[int, bytes]], count: int, counts: dict[str, int]) -> None:
    decoder, sequence = Decoder(), 0
    for _ in range(count):
        sequence += 1
        kind, body = samples[int(rng.integers(len(samples)))]
        data = bytearray(encode(kind, sequence, body) if rng.random() < 0.9 else rng.bytes(int(rng.integers(1, 64))))
        for _ in range(int(rng.integers(0, 3))):
            data[int(rng.integers(len(data)))] = int(rng.integers(256))
        if rng.random() < 0.05:
            del data[int(rng.integers(len(data))) :]
        decoder.feed(bytes(data))
        frame = decoder.next()
        if frame is None or isinstance(frame, Broken):
            counts["broken"] += frame is not None
            decoder, sequence = Decoder(), 0
            continue
        counts["refused" if isinstance(read(frame, upward=True), str) else "messages"] += 1
