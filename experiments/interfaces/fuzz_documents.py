"""Hundred thousand fuzzed documents and descriptions of robots, read in bounded processes.

Each unit reads a batch in one process with the limits of a single document. The functions are those that the product
runs there. An exception that is not one of dualbrain would be a rejection, too, and is counted by its type.
"""

from __future__ import annotations

import resource
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import msgspec

from dualbrain.core.untrusted.bounded_process import ProcessFailure, ProcessLimits, run_bounded
from dualbrain.errors import DualbrainError
from dualbrain.knowledge.readers import extraction
from dualbrain.robots.importer import urdf
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table

N_DOCUMENTS = 100_000
DOCUMENTS_PER_UNIT = 500
MAX_BYTES = 20_000
BATCH_SECONDS = 900.0
TOKEN_TEXT = """
* ** _ __ [ ] ( ) ` ``` # > - | \\ { } &amp; &#x202e; <!-- --> <![CDATA[ <div> </div> <p/style='opacity:0'> <style>
font-size:1e-9px left:-9999px rgb(255,255,255) <link> <joint> <origin/xyz='nan'> 1e999 -1 q Q BT ET Tj Tz Tr /F1
stream endstream endobj obj << >> %PDF-1.7 xref trailer
"""
TOKENS = TOKEN_TEXT.split()
"""Tokens that mean something in one of the formats."""


def make_pdf(content: str) -> bytes:
    """A PDF with one page of the operators `content`; its cross-reference table is found by a search."""
    objects = (
        "<</Type/Catalog/Pages 2 0 R>>",
        "<</Type/Pages/Kids[3 0 R]/Count 1>>",
        "<</Type/Page/Parent 2 0 R/MediaBox[0 0 612 792]/Contents 4 0 R/Resources<</Font<</F1 5 0 R>>>>>>",
        f"<</Length {len(content)}>>stream\n{content}\nendstream",
        "<</Type/Font/Subtype/Type1/BaseFont/Helvetica/Encoding/WinAnsiEncoding>>",
    )
    data, offsets = "%PDF-1.4\n", list[int]()
    for number, text in enumerate(objects, 1):
        offsets.append(len(data))
        data += f"{number} 0 obj{text}endobj\n"
    table = "".join(f"{offset:010d} 00000 n \n" for offset in offsets)
    end = f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}trailer<</Root 1 0 R/Size {len(objects) + 1}>>\n"
    return f"{data}{end}startxref\n{len(data)}\n%%EOF\n".encode()


SAMPLES = {
    "Markdown": b"# Gripper\n\nHold a *glass* with at most **10 N**.\n\n| part | force |\n|---|---|\n| cube | 20 |\n",
    "HTML": b"<html><head><style>p.x{color:#fff}</style></head><body><h1>Manual</h1><p class='x'>a</p>"
    b"<table><tr><td style='font-size:1px'>b</td></tr></table><details><p>c</p></details></body></html>",
    "PDF": make_pdf("BT /F1 12 Tf 72 700 Td (force 10 N) Tj ET"),
    "URDF": b"<robot name='a'><link name='l0'/><link name='l1'><collision><geometry><box size='.1 .1 .1'/></geometry>"
    b"</collision></link><joint name='j' type='revolute'><parent link='l0'/><child link='l1'/><axis xyz='0 0 1'/>"
    b"<limit lower='-1' upper='1' velocity='1' effort='1'/></joint></robot>",
}


class FuzzDocuments:
    """Texts, rejections and exceptions by format, with memory and time."""

    name = "fuzz_documents"
    claim = (
        "10⁵ fuzzed documents and descriptions are each read or rejected within the memory and the time of the bounded "
        "process."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Return the batches, one format after the other."""
        del options
        batches = N_DOCUMENTS // DOCUMENTS_PER_UNIT // len(SAMPLES)
        return [
            WorkUnit(f"{kind} {seed}", {"kind": kind, "seed": seed, "documents": DOCUMENTS_PER_UNIT})
            for seed in range(batches)
            for kind in SAMPLES
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Read one batch in a process with the limits of one document; only its time is that of the batch."""
        limits = ProcessLimits(seconds=BATCH_SECONDS)
        found = run_bounded(f"{__name__}:read_batch", msgspec.json.encode(parameters), limits)
        if isinstance(found, ProcessFailure):
            return {"kind": parameters["kind"], "counts": {}, "failure": f"{found.kind}: {found.reason}"}
        return {"kind": parameters["kind"], "failure": "", **msgspec.json.decode(found)}

    def summarize_row(self, row: Row) -> str:
        """Summarize the row for the progress line."""
        return f"{row['kind']}: {row['counts']} {row['failure']}"

    def report(self, rows: list[Row]) -> list[str]:
        """Report one line for each format, and the batches whose process failed."""
        cells: list[tuple[str, ...]] = []
        for kind in SAMPLES:
            found = [row for row in rows if row["kind"] == kind and not row["failure"]]
            counts = sum((Counter(row["counts"]) for row in found), Counter[str]())
            exceptions = {name: count for name, count in counts.items() if name.startswith("exception")}
            cells.append(
                (
                    kind,
                    f"{counts.total():,}",
                    f"{counts['read']:,}",
                    f"{counts['rejected']:,}",
                    ", ".join(f"{name.partition(' ')[2]} {count}" for name, count in exceptions.items()) or "none",
                    f"{1e3 * sum(row['seconds'] for row in found) / max(counts.total(), 1):.1f} ms",
                    f"{max((row['longest_s'] for row in found), default=0.0):.2f} s",
                    f"{max((row['grown_kib'] for row in found), default=0) / 1024:.0f} MiB",
                )
            )
        heads = (
            "format",
            "documents",
            "read",
            "rejected",
            "exceptions",
            "time, mean",
            "longest",
            "memory, largest growth",
        )
        failures = [f"- {row['key']}: {row['failure']}" for row in rows if row["failure"]]
        return [*markdown_table(heads, cells), "", f"Batches whose process failed: {len(failures)}.", *failures]


def read_batch(argument: bytes) -> bytes:
    """Read the documents of a batch; runs in the bounded process."""
    parameters = msgspec.json.decode(argument)
    rng, read = Random(f"{parameters['kind']} {parameters['seed']}"), READERS[parameters["kind"]]
    sample, counts, longest = SAMPLES[parameters["kind"]], Counter[str](), 0.0
    if not read(sample):
        raise ValueError(f"the sample of {parameters['kind']} is not read")
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    for _ in range(parameters["documents"]):
        data, began = fuzzed(sample, rng), time.process_time()
        counts[_outcome(read, data)] += 1
        longest = max(longest, time.process_time() - began)
    spent, grown = time.process_time() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return msgspec.json.encode({"counts": counts, "seconds": spent, "longest_s": longest, "grown_kib": grown})


def fuzzed(sample: bytes, rng: Random) -> bytes:
    """The sample with slices repeated, tokens inserted, and bytes changed or removed."""
    data = bytearray(sample)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8, 30))):
        at, kind = rng.randrange(len(data) + 1), rng.random()
        if kind < 0.3:
            slice_ = bytes(data[at : at + rng.randrange(1, 40)])
            data[at:at] = slice_ * rng.choice((1, 2, 10, 100, 1000))
        elif kind < 0.6:
            data[at:at] = (rng.choice(TOKENS).encode() + rng.choice((b"", b" ", b"\n"))) * rng.choice(
                (1, 1, 3, 50, 1000)
            )
        elif kind < 0.8 and data:
            data[rng.randrange(len(data))] = rng.randrange(256)
        else:
            del data[at : at + rng.randrange(1, 20)]
        del data[MAX_BYTES:]
    return bytes(data)


def _token(rng: Random) -> bytes:
    return (rng.choice(TOKENS) + rng.choice(("", " ", "\n"))).encode()


def _outcome(read: Callable[[bytes], bool], data: bytes) -> str:
    try:
        return "read" if read(data) else "rejected"
    except (DualbrainError, UnicodeDecodeError):  # the reader rejects wrong UTF-8 before it starts a process
        return "rejected"
    except Exception as error:
        return f"exception {type(error).__name__}"


def _reader(function: Callable[[bytes], bytes]) -> Callable[[bytes], bool]:
    def read(data: bytes) -> bool:
        return msgspec.msgpack.decode(function(data), type=extraction.Extraction).rejection is None

    return read


def _read_urdf(data: bytes) -> bool:
    argument = msgspec.msgpack.encode((str(Path("robot.urdf").absolute()), [], data))
    return bool(urdf.encode_urdf(argument))


READERS: dict[str, Callable[[bytes], bool]] = {
    "Markdown": _reader(extraction.extract_markdown),
    "HTML": _reader(extraction.extract_html),
    "PDF": _reader(extraction.extract_pdf),
    "URDF": _read_urdf,
}
