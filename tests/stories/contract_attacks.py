"""The attacks in `contract_attacks.json`: their bytes, the verdict of the gate, and the page of the results.

`python -m tests.stories.contract_attacks` writes docs/reference/verification/attacks.md.
"""

import base64
import json
from collections import Counter
from pathlib import Path
from typing import Any

from dualbrain.contracts.contract import ContractHeader
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.gate.strict_json import MAX_BYTES
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.verdict import Accepted, Verdict
from tests.contracts.contract_strategies import NAMES, PRINCIPAL, REGISTRY

FOLDER = Path(__file__).parent
PAGE_FILE = FOLDER.parents[1] / "docs" / "reference" / "verification" / "attacks.md"
ATTACKS: list[dict[str, Any]] = json.loads((FOLDER / "contract_attacks.json").read_text())
CONTRACT_TEMPLATE = '{"id":"c-0001","context":{"robot":"panda","registry":"%s"},"action_sequence":%s}'
HOME_ACTION = '{"skill":"home","params":{"speed":0.1}}'
VALID_CONTRACT = CONTRACT_TEMPLATE % (REGISTRY.hash, f"[{HOME_ACTION}]")
GRANTS = {PRINCIPAL: frozenset(REGISTRY.by_name), "guest": frozenset({"decline"})}
NOW, SCENE_VERSION = 100.0, 3
STAGES = ("syntax", "authorization", "envelope", "accepted")


def attack_bytes(attack: dict[str, Any]) -> bytes:
    """The bytes that the gate receives."""
    if "generator" in attack:
        return generate_bytes(attack)
    if "base64" in attack:
        return base64.b64decode(attack["base64"])
    text = CONTRACT_TEMPLATE % (REGISTRY.hash, attack["steps"]) if "steps" in attack else attack["text"]
    return text.replace("$GOOD", VALID_CONTRACT).replace("$REGISTRY", REGISTRY.hash).encode()


def generate_bytes(attack: dict[str, Any]) -> bytes:
    """Bytes that are too long or too unusual for the file."""
    size = attack.get("size", 0)
    match attack["generator"]:
        case "digits":
            return VALID_CONTRACT.replace("0.1", "9" * size).encode()
        case "quoted":
            return json.dumps(VALID_CONTRACT).encode()
        case "prefixed":
            return base64.b64decode(attack["base64"]) + VALID_CONTRACT.encode()
        case "encoded":
            return VALID_CONTRACT.encode(attack["encoding"])
        case "nested":
            return b"[" * size + b"]" * size
        case "nested_params":
            return VALID_CONTRACT.replace("0.1", '{"a":' * size + "0.1" + "}" * size).encode()
        case "padded":
            return VALID_CONTRACT.encode().ljust(size)
        case "many_steps":
            return (CONTRACT_TEMPLATE % (REGISTRY.hash, "[" + ",".join([HOME_ACTION] * size) + "]")).encode()
        case "many_fields":
            return VALID_CONTRACT.replace('"speed"', "".join(f'"x{i}":0,' for i in range(size)) + '"speed"').encode()
        case other:
            raise AssertionError(other)


def run_attack(attack: dict[str, Any]) -> Verdict:
    """The verdict of a new gate on `attack`; `after` is the sequence number that was accepted before it."""
    gate = Gate(REGISTRY, GRANTS)
    names = SceneNames(NAMES.graspable, NAMES.receptive, SCENE_VERSION)
    if "after" in attack:
        before = make_header({"sequence": attack["after"]})
        assert isinstance(
            gate.check(VALID_CONTRACT.encode(), names=names, principal=PRINCIPAL, now=NOW, header=before), Accepted
        )
    header = make_header(attack["stamp"]) if "stamp" in attack else None
    principal = attack.get("principal", PRINCIPAL)
    return gate.check(attack_bytes(attack), names=names, principal=principal, now=NOW, header=header)


def make_header(changes: dict[str, Any]) -> ContractHeader:
    """A valid header except for `changes` (times may be written as "nan")."""
    fields = {"sequence": 1, "issued": NOW - 1, "expires": NOW + 1, "principal": PRINCIPAL}
    fields |= {"scene_version": SCENE_VERSION} | changes
    return ContractHeader(**fields | {key: float(fields[key]) for key in ("issued", "expires")})


def rejecting_stage(verdict: Verdict) -> str:
    """The stage that rejected the contract, or "accepted"."""
    return "accepted" if isinstance(verdict, Accepted) else verdict.stage


def render_page(outcomes: list[str]) -> str:
    """docs/reference/verification/attacks.md, from the result of each attack."""
    pairs = list(zip(ATTACKS, outcomes, strict=True))
    as_predicted = Counter(attack["class"] for attack, outcome in pairs if outcome == attack["expected"])
    rows = [
        "| {} | {} | {} | {} |".format(
            name,
            sum(counts.values()),
            " | ".join(str(counts[s] or "") for s in STAGES),
            f"{as_predicted[name]}/{counts.total()}",
        )
        for name, counts in count_by_class().items()
    ]
    by_stage = Counter(attack["expected"] for attack in ATTACKS)
    total = " | ".join(f"**{by_stage[stage]}**" for stage in STAGES)
    rows.append(f"| **all** | **{len(ATTACKS)}** | {total} | **{as_predicted.total()}/{len(ATTACKS)}** |")
    accepted = [f"| {a['class']} | {a['name']} | {a['then']} |" for a in ATTACKS if a["expected"] == "accepted"]
    return PREFACE + "\n".join(rows) + MIDDLE + "\n".join(accepted) + "\n"


def count_by_class() -> dict[str, Counter[str]]:
    """Number of attacks of each class by expected stage, in the order of the file."""
    table: dict[str, Counter[str]] = {}
    for attack in ATTACKS:
        table.setdefault(attack["class"], Counter())[attack["expected"]] += 1
    return table


PREFACE = f"""# Attacks on the gate

{len(ATTACKS)} attacks, the stage that must stop each of them, and the stage that did. Each case in
`tests/stories/contract_attacks.json` is one byte string, or one header around a valid contract, with its expected
stage, which was written down beforehand. A test sends every case to a new gate (the eight skills of an arm, a scene of
five names) and compares. This page is written by `python -m tests.stories.contract_attacks`; a test requires that it is
current.

The stages run in order, and each checks the whole contract: **syntax** (bytes up to {MAX_BYTES // 1024} KiB, strict
JSON, fields, types, array sizes), **authorization** (skill, robot, registry, principal, header), **envelope** (bounds,
choices, names of the scene, hidden characters in text). The last column counts the cases that ended as predicted.

| class | cases | syntax | authorization | envelope | accepted | as predicted |
|---|---:|---:|---:|---:|---:|---:|
"""

MIDDLE = """

## Accepted cases

These are valid contracts, which no schema can detect. The last column names the part of the system that handles each
case; *none* means that no part can, so a person must not rely on it.

| class | case | handled by |
|---|---|---|
"""

if __name__ == "__main__":
    PAGE_FILE.write_text(render_page([rejecting_stage(run_attack(attack)) for attack in ATTACKS]))
