"""Model card of an adapter for the Hugging Face Hub: README.md with YAML, made from the adapter's own card.

The card states base, data set, results of the promotion gate with their intervals, and everything against the adapter.
Text from cards and logs is escaped; the YAML is written by the library of the hub.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime

from huggingface_hub import EvalResult, ModelCardData

from dualbrain.adaptation.adapters.card import AdapterCard
from dualbrain.adaptation.adapters.promotion import MeasureComparison, PromotionDecision
from dualbrain.adaptation.adapters.registry import RegistryEntry
from dualbrain.core.markdown import escape_markdown, markdown_table
from dualbrain.core.weights import find_weight_file

HUB_MODELS = {
    "smollm2-135m-instruct": "HuggingFaceTB/SmolLM2-135M-Instruct",
    "qwen2.5-coder-0.5b-instruct": "Qwen/Qwen2.5-Coder-0.5B-Instruct",
    "qwen2.5-coder-1.5b-instruct": "Qwen/Qwen2.5-Coder-1.5B-Instruct",
}
"""The model on the hub from which each base was quantised."""
TAGS = ["dualbrain", "lora", "robotics", "robot-planning"]
TASK = "text-generation"
NOT_MEASURED = (
    "The promotion gate has no measurement of this adapter: it is not known whether its contracts succeed on a robot."
)
LIMITS = """\
- The adapter answers with a contract for a robot, in the JSON form of dualbrain. It is not a chat model.
- Its answers are untrusted: execute them only through the gate and the safety filter of dualbrain, which reject or
  change unsafe ones. The adapter contributes nothing to safety.
- It was trained for the robots, skill vocabularies and prompt named above, on a base in 4 bits. Other robots, other
  prompts and other precisions were not measured."""


def hub_model_name(base: str) -> str:
    """The name on the hub of the language model `base`; `base` itself if it is not known."""
    return HUB_MODELS.get(base, base)


def model_card(
    stack: Sequence[AdapterCard],
    weights_sha256: str,
    decision: PromotionDecision | None = None,
    history: Sequence[RegistryEntry] = (),
) -> str:
    """The text of README.md for the last adapter of `stack`, which is exported with all adapters below it.

    `weights_sha256` is the hash of the exported weights. `decision` is the newest comparison by the promotion gate,
    positive or not, and `history` has the adapter's entries in the registry.
    """
    card = stack[-1]
    sections = [
        f"# dualbrain adapter {card.id[:16]}",
        f"A low-rank adapter for {escape_markdown(hub_model_name(stack[0].base))}. With it, the model plans for the "
        f"robot {escape_markdown(card.robot)}: it answers a scene and an instruction with a typed contract.",
        "## Origin",
        "\n".join(_table(("", ""), _origin(stack, weights_sha256))),
        "## Results",
        *_results(card, decision),
        *_history(history),
        "## Limits",
        LIMITS,
        "## Use",
        _usage(stack[0].base),
    ]
    return f"---\n{_metadata(stack, decision).to_yaml()}\n---\n\n" + "\n\n".join(sections) + "\n"


def _metadata(stack: Sequence[AdapterCard], decision: PromotionDecision | None) -> ModelCardData:
    card, base = stack[-1], stack[0].base
    return ModelCardData(
        base_model=hub_model_name(base),
        library_name="peft",
        license=find_weight_file(base).licence.lower(),
        pipeline_tag=TASK,
        tags=TAGS,
        model_name=f"dualbrain-{card.id[:16]}",
        eval_results=[*_held_out_results(card), *_gate_results(card, decision)],
    )


def _held_out_results(card: AdapterCard) -> Iterator[EvalResult]:
    if card.held_out is not None:
        yield _result(card.dataset, "held-out loss [nats/token]", "loss", card.held_out.loss)
        if card.held_out.compliance is not None:
            yield _result(card.dataset, "held-out compliance", "compliance", card.held_out.compliance)


def _gate_results(card: AdapterCard, decision: PromotionDecision | None) -> Iterator[EvalResult]:
    for name, found in decision.measures.items() if decision else ():
        arguments = {"before": found.before, "gain": found.gain, "gain_low": found.low, "gain_high": found.high}
        dataset = decision.dataset if decision and decision.dataset else card.dataset
        yield _result(dataset, f"{name} (promotion gate)", name, found.after, arguments)


def _result(
    dataset: str, title: str, kind: str, value: float, arguments: dict[str, float | None] | None = None
) -> EvalResult:
    return EvalResult(
        task_type=TASK,
        dataset_type="dualbrain",
        dataset_name=f"held-out questions of data set {dataset}",
        metric_type=kind,
        metric_name=title,
        metric_value=value,
        metric_args=arguments,
    )


def _origin(stack: Sequence[AdapterCard], weights_sha256: str) -> Iterator[tuple[str, str]]:
    card, lowest, fit = stack[-1], stack[0], stack[-1].config.fit
    robots = {card.robot: card.registry} | card.also
    yield "adapter (SHA-256 of its weights)", card.id
    yield "exported weights (SHA-256)", weights_sha256
    yield "base", lowest.base
    yield "base (SHA-256 of the GGUF file)", lowest.base_sha256
    for below in stack[:-1]:
        yield "contains the adapter below", f"{below.id}, data set {below.dataset}"
    yield "data set (hash)", card.dataset
    yield "samples by proposing planner", ", ".join(f"{name}: {count}" for name, count in card.sources.items())
    yield "bootstrapped by other planners", "yes" if card.bootstrapped else "no"
    yield "robots (hash of their skills)", ", ".join(f"{robot} ({skills})" for robot, skills in robots.items())
    yield "prompt (hash)", card.prompt
    yield "training", f"{card.steps} steps, {card.precision}, rank {fit.rank}, alpha {fit.alpha}"
    yield "versions", ", ".join(f"{name} {version}" for name, version in card.versions.items())


def _results(card: AdapterCard, decision: PromotionDecision | None) -> Iterator[str]:
    if card.held_out is None:
        yield "No held-out questions were evaluated during training."
    else:
        asked = card.held_out.compliance
        compliance = "no answers were generated" if asked is None else f"{asked:.1%} of the answers were compliant"
        yield (
            f"During training, at step {card.held_out.step}: held-out loss {card.held_out.loss:.4g} nats per token; "
            f"{compliance}."
        )
    if decision is None:
        yield NOT_MEASURED
        return
    champion = f"adapter {decision.champion[:16]}" if decision.champion else "the bare base"
    verdict = "Promoted" if decision.promotes else "**Not promoted**"
    runtime = escape_markdown(decision.runtime) or "a runtime that was not recorded"
    yield f"{verdict} after a comparison with {champion} in {runtime}."
    heads = ("measure", "before", "after", "gain", "95 % interval of the gain", "p (corrected)", "tolerance", "result")
    yield "\n".join(_table(heads, (_measure_row(name, found) for name, found in decision.measures.items())))
    if decision.against:
        yield "Against a promotion:"
        yield "\n".join(f"- {escape_markdown(reason)}" for reason in decision.against)


def _measure_row(name: str, found: MeasureComparison) -> tuple[str, ...]:
    interval = "too few questions" if found.low is None else f"{found.low:+.4g} to {found.high:+.4g}"
    result = "worse" if found.is_worse else "better" if found.is_better else "no significant improvement"
    p = "–" if found.p is None else f"{found.p:.2g}"
    numbers = (f"{found.before:.4g}", f"{found.after:.4g}", f"{found.gain:+.4g}", interval, p, f"{found.tolerance:.4g}")
    return name, *numbers, result


def _history(entries: Sequence[RegistryEntry]) -> Iterator[str]:
    if entries:
        yield "## History"
        yield "\n".join(
            f"- {datetime.fromtimestamp(one.time, UTC):%Y-%m-%d}: {one.kind}"
            + (f". {escape_markdown(one.reason)}" if one.reason else "")
            for one in entries
        )


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    return markdown_table(heads, ([escape_markdown(cell) for cell in row] for row in rows), pipe="|")


def _usage(base: str) -> str:
    return f"""```python
from peft import PeftModel
from transformers import AutoModelForCausalLM

base = AutoModelForCausalLM.from_pretrained("{hub_model_name(base)}")
model = PeftModel.from_pretrained(base, "PATH OR NAME OF THIS FOLDER")
```"""
