"""Rounds with stubs for model, execution and training: sources, splits, starting points, and interruptions."""

import hashlib
import json
from contextlib import suppress
from functools import cache
from itertools import count
from types import SimpleNamespace

import msgspec
import pytest

from dualbrain.adaptation.adapters.base_models import BaseModel
from dualbrain.adaptation.adapters.card import (
    WEIGHTS_FILE,
    AdapterCard,
    has_foreign_proposals,
    read_adapter_card,
    write_adapter_card,
)
from dualbrain.adaptation.adapters.packaged import packaged_folder
from dualbrain.adaptation.adapters.stacking import AdapterLayer, AdapterStack
from dualbrain.adaptation.curation.dataset import read_dataset
from dualbrain.adaptation.synthetic.split import SCENE_SEEDS
from dualbrain.runtime.data_collection import rollouts
from dualbrain.runtime.data_collection.rollouts import instruction_of, is_declined, memory_id_of_turn
from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples
from experiments.adaptation import round_chain, rounds, suite_adapters
from experiments.engine.experiment import Options
from experiments.figures.plot_rounds import plot_rounds
from tests.adaptation.sample_episodes import episode, pick_contract, summary, write_ledger

BASE = BaseModel(
    name="base-135m",
    gguf=packaged_folder("base-135m"),
    gguf_sha256="gguf",
    stacked_on=(),
    stacked_on_id=read_adapter_card(packaged_folder("base-135m")).id,
)
CONTRACT = json.dumps(pick_contract())
PLACES = round_chain.N_PLACES


class Interruption(BaseException):
    """Acts like a kill."""


@pytest.fixture(scope="module")
def small():
    """Few held-out requests and instructions, drawn once for all tests of this module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(round_chain, "N_PLACES", 20)
        patch.setattr(round_chain, "N_INSTRUCTIONS", 10)
        for drawn in (round_chain.held_out_places, round_chain.instructions):
            patch.setattr(round_chain, drawn.__name__, cache(drawn.__wrapped__))
        yield


def fake_model(act, prompts):
    """A model class that proposes the same contract three times of four, and answers held-out requests correctly."""

    class FakeModel:
        def __init__(self, stack):
            assert stack.layers

        def generate_one(self, question, sampling):
            act()
            prompts.append(question.prompt[-1]["content"])
            return CONTRACT if sampling.seeds[0] % 4 else "no contract"

        def generate(self, questions):
            return [question.contract for question in questions]

    return FakeModel


@pytest.fixture
def stubs(small, monkeypatch):
    """Stubs for model, execution and training; `countdown` reaches 0 at the action that is interrupted."""
    state = SimpleNamespace(countdown=count(1), fits=[], prompts=[])

    def act():
        if next(state.countdown) == 0:
            raise Interruption

    def run_proposal(one, ledger, turn, *, cache):
        act()
        made = episode(
            memory_id_of_turn(turn),
            proposer=one.source,
            scene_summary=summary(number=turn),
            instruction=instruction_of(one),
        )
        if ledger.parent.name == "partial":
            write_ledger(ledger.parent, [made]).close()
        return made

    def adapt(data, config, base, judge, folder, *, report, own_adapters, **others):
        act()
        state.fits.append((base.sha256, config, data.card.sources))
        for step in (1, 2):
            report(SimpleNamespace(step=step))
        (folder / "adapter").mkdir()
        (folder / "adapter" / WEIGHTS_FILE).write_text(f"{data.card.hash} {base.sha256}")
        made = hashlib.sha256((folder / "adapter" / WEIGHTS_FILE).read_bytes()).hexdigest()
        card = data.card
        write_adapter_card(
            AdapterCard(
                id=made,
                base=base.name,
                base_sha256=base.sha256,
                robot=card.robot,
                registry=card.registry,
                prompt=card.prompt,
                dataset=card.hash,
                sources=card.sources,
                bootstrapped=has_foreign_proposals(card.sources, base.name, own_adapters),
                precision="float32",
                steps=2,
                held_out=None,
                config=config,
                versions={},
            ),
            folder / "adapter",
        )

    def load_stack(folder, cache):
        return AdapterStack("smollm2-135m-instruct", folder, (AdapterLayer(folder, read_adapter_card(folder)),))

    train = pytest.importorskip("dualbrain.adaptation.training.train", reason="the extra `adapt` is not installed")
    monkeypatch.setattr(train, "adapt", adapt)
    monkeypatch.setattr(rollouts, "run_proposal", run_proposal)
    monkeypatch.setattr(rollouts, "EPISODES_PER_STEP", 4)
    replacements = {
        "run_proposal": run_proposal,
        "FreeAnswerModel": fake_model(act, state.prompts),
        "load_stack": load_stack,
        "find_base_model": lambda name, cache: (
            BASE if name == BASE.name else BaseModel(name=name, gguf=cache, gguf_sha256="other")
        ),
    }
    for name, stub in replacements.items():
        monkeypatch.setattr(round_chain, name, stub)
    return state


def run_rounds(folder, numbers=range(rounds.N_ROUNDS + 1)):
    """The rows of these rounds, without the training time."""
    rows = [rounds.Rounds().run({"seed": 0, "round": number, "folder": str(folder)}) for number in numbers]
    assert all(row.pop("fit_s") > 0.0 for row in rows if row["round"])
    return rows


def test_no_proposal_is_for_a_held_out_request(small):
    """They share neither scenes nor sentences; and no two rounds or chains have the same requests."""
    held_out = round_chain.held_out_places()
    batches = [round_chain.instructions(seed, number) for seed in range(2) for number in range(rounds.N_ROUNDS)]
    every = [one for some in batches for one in some]
    assert not {one.scene for one in held_out} & {one.scene for one in every}
    assert not {instruction_of(one).lower() for one in held_out} & {instruction_of(one).lower() for one in every}
    assert all(int(one.scene.rpartition(":")[2]) in SCENE_SEEDS["test"] for one in held_out)
    assert all(int(one.scene.rpartition(":")[2]) in SCENE_SEEDS["teach"] for one in every)
    assert len({one.prompt[-1]["content"] for one in every}) == len(every)
    assert any(map(is_declined, every))
    assert all(map(round_chain.has_one_goal, (*held_out, *every)))
    assert len(held_out) == round_chain.N_PLACES
    assert {len(some) for some in batches} == {round_chain.N_INSTRUCTIONS}


@pytest.mark.slow
def test_there_are_a_hundred_held_out_requests_with_motion():
    held_out = generate_examples(PLACES, "test", round_chain.HELD_OUT_SEED, {"panda": 1.0}, exemplar_share=0.0)
    assert sum(not is_declined(one) for one in held_out) >= 100


def test_only_the_model_proposes_and_every_training_starts_from_the_base(stubs, tmp_path):
    rows = run_rounds(tmp_path)
    cards = [read_adapter_card(tmp_path / "chain 0" / f"fit {number}" / "adapter") for number in (1, 2, 3)]
    names = ["base-135m", *(f"base-135m+{card.id[:16]}" for card in cards)]
    assert [sha for sha, _, _ in stubs.fits] == [BASE.sha256] * 3
    assert [set(sources) for _, _, sources in stubs.fits] == [set(names[: number + 1]) for number in range(3)]
    assert [row["adapter"] for row in rows[1:]] == [card.id for card in cards]
    assert not any(row["bootstrapped"] for row in rows[1:])
    assert [row["proposed"] for row in rows[1:]] == [10, 20, 30]
    for number in (1, 2, 3):
        data = read_dataset(tmp_path / "chain 0" / f"fit {number}" / "dataset")
        assert not has_foreign_proposals(data.card.sources, "base-135m", [card.id for card in cards[: number - 1]])
        assert {instruction_of(one) for one in data.train} <= {
            instruction_of(one) for earlier in range(number) for one in round_chain.instructions(0, earlier)
        }


def test_ablations_are_trained_on_the_same_episodes(stubs, tmp_path, monkeypatch):
    """Only one setting differs: data of the last round, steps and seed are the same; a selection may admit more."""
    found = []
    registry = SimpleNamespace(add=lambda folder, *, now: found.append(read_adapter_card(folder).id))
    monkeypatch.setattr(suite_adapters, "open_adapter_registry", lambda: registry)
    units = suite_adapters.SuiteAdapters().units(Options(tmp_path, "any"))
    rows = {unit.key: suite_adapters.SuiteAdapters().run(unit.parameters) for unit in units}
    configs = [config for _, config, _ in stubs.fits[-5:]]
    assert set(rows) == {"adapted", *round_chain.ABLATIONS}
    assert found == [row["adapter"] for row in rows.values()]
    assert rows["adapted"]["dataset"] == rows["adapted_no_kl"]["dataset"] == rows["adapted_no_entropy"]["dataset"]
    assert rows["adapted_all"]["samples"] >= rows["adapted_success"]["samples"] >= rows["adapted"]["samples"]
    assert {config.fit for config in configs} == {configs[0].fit}
    assert [(one.objective.beta, one.objective.lambda_h) for one in configs] == [
        (0.05, 0.5),
        (0.05, 0.0),
        (0.0, 0.5),
        (0.05, 0.5),
        (0.05, 0.5),
    ]
    assert "adapted_no_kl" in "\n".join(suite_adapters.SuiteAdapters().report(list(rows.values())))


def test_proposals_of_another_planner_are_not_trained_on(tmp_path):
    others = [
        episode(f"e{i}", proposer=proposer, scene_summary=summary(number=i))
        for i, proposer in enumerate(("base-135m", "templates"))
    ]
    write_ledger(tmp_path, others).close()
    with pytest.raises(AssertionError, match="templates"):
        round_chain.select_training_data(tmp_path / rollouts.LEDGER_FILE, ())


@pytest.mark.parametrize("after", [9, 30, 75])
def test_an_interruption_anywhere_does_not_change_the_rows(stubs, tmp_path, after):
    whole = run_rounds(tmp_path / "whole")
    stubs.countdown = count(-after)
    with suppress(Interruption):
        run_rounds(tmp_path / "again")
        pytest.fail("was not interrupted")
    stubs.prompts.clear()
    assert run_rounds(tmp_path / "again") == whole
    assert len(stubs.prompts) <= 30
    assert run_rounds(tmp_path / "again") == whole


def test_rounds_may_run_in_any_order(stubs, tmp_path):
    assert run_rounds(tmp_path / "one", (3, 1, 0, 2)) == run_rounds(tmp_path / "other", (3, 1, 0, 2))
    assert (
        sorted(run_rounds(tmp_path / "one", (2, 0)), key=lambda row: row["round"])[1]
        == run_rounds(tmp_path / "other", (2,))[0]
    )


def test_only_declines_of_infeasible_requests_are_trained_on(small, tmp_path):
    every = [one for number in (0, 1) for one in round_chain.instructions(0, number)]
    named = round_chain.RoundChain(0, tmp_path).correct_declines(2)
    assert [is_declined(every[rollouts.turn_of_memory_id(name)]) for name in named] == [True] * sum(
        map(is_declined, every)
    )


def test_a_repeated_step_counts_once(tmp_path):
    ticks = iter((0.0, 5.0, 7.0, 100.0, 103.0, 104.0))
    for steps_taken in ((1, 2), (2, 3)):
        with (tmp_path / "seconds.txt").open("a") as log:
            write_step = round_chain.step_time_logger(log, lambda: next(ticks))
            for step in steps_taken:
                write_step(SimpleNamespace(step=step))
    assert round_chain.total_step_time(tmp_path / "seconds.txt") == pytest.approx(5.0 + 3.0 + 1.0)


def row(number, results, **fields):
    """A row of episodes, one per request: (Δ or None, whether it was a success)."""
    episodes = [
        {
            "id": f"place {i}",
            "compliant": size is not None,
            "right": good,
            "success": good,
            "to_decline": i == 0,
            "outcome": "succeeded" if size is not None else "declined" if i == 0 else "rejected",
            "Delta": size,
            "frequency": None if size is None else 0.25,
            "completion_s": None if size is None else 10.0,
        }
        for i, (size, good) in enumerate(results)
    ]
    training = {
        "adapter": f"{number}" * 64,
        "bootstrapped": False,
        "proposed": 10,
        "samples": 4,
        "as_said": 3,
        "fit_s": 61.0,
        "left_out": {"outcome failed": 2},
    }
    return {"seed": 0, "round": number, "episodes": episodes, **(training if number else {}), **fields}


ROWS = [
    row(0, [(None, True), (0.004, True), (0.002, False), (None, False)]),
    row(1, [(0.5, False), (0.003, True), (0.001, True), (0.001, True)]),
]


def test_tables_compare_the_same_requests():
    text = "\n".join(rounds.Rounds().report(ROWS))
    assert "| 0 | 1 | 4 | 50% (4% to 96%), n = 4 |" in text
    assert "| 1 | 1 | 4 | 100% (" in text
    assert rounds.format_difference("Δ of successes", ROWS[:1], ROWS[1:]).startswith("-0.0010 (")
    assert rounds.format_difference("Δ of successes", ROWS[:1], ROWS[1:]).endswith(
        ", 1"
    )  # only requests that succeeded in both
    assert rounds.format_difference("declined if required", ROWS[:1], ROWS[1:]).startswith("-100%")
    assert rounds.format_difference("time to completion [s]", ROWS[:1], ROWS[1:]) == "+0.0 (-inf to +inf), 1"
    assert "| 0 | 1 | 10 | 4 | 3 of 4 (" in text
    assert "2 outcome failed" in text
    decoded = msgspec.json.decode(msgspec.json.encode(ROWS))
    assert "\n".join(rounds.Rounds().report(decoded)) == text


def test_some_of_the_rounds_have_a_table_and_a_plot(tmp_path):
    for some in (ROWS, ROWS[:1], ROWS[1:]):
        assert "| round | chains | episodes |" in "\n".join(rounds.Rounds().report(some))
        plot_rounds(some, tmp_path / "x.png")
        assert (tmp_path / "x.png").stat().st_size > 1000


def test_an_episode_is_judged_as_in_the_evaluation(small, monkeypatch):
    """An infeasible request succeeds if nothing moved, others if the contract is correct and the robot agrees."""
    monkeypatch.setattr(round_chain, "run_proposal", lambda one, ledger, turn, cache: executed)
    requests = [(turn, one) for turn, one in enumerate(round_chain.held_out_places()) if '"place"' not in one.contract]
    turn, feasible = next(pair for pair in requests if not is_declined(pair[1]))
    other, infeasible = next(pair for pair in requests if is_declined(pair[1]))
    for kind in ("succeeded", "failed"):
        executed = episode("x", kind, plan=pick_contract(), duration=8.0)
        executed = msgspec.structs.replace(executed, contract=json.loads(feasible.contract))
        found = round_chain.run_held_out_episode(turn, feasible.contract, "base-135m")
        assert (found["right"], found["success"]) == (True, kind == "succeeded")
        assert found["completion_s"] == 10.0
    wrong = round_chain.run_held_out_episode(turn, "nonsense", "base-135m")
    assert (wrong["outcome"], wrong["success"], wrong["Delta"]) == ("rejected", False, None)
    for text, outcome in ((infeasible.contract, "declined"), ("nonsense", "rejected")):
        found = round_chain.run_held_out_episode(other, text, "base-135m")
        assert (found["outcome"], found["success"], found["to_decline"]) == (outcome, True, True)
        assert found["compliant"] == (outcome == "declined")
