"""Rounds: who proposed, what is kept apart, from where is fitted, and that a stop changes nothing; nobody flies."""

import hashlib
import json
from contextlib import suppress
from functools import cache
from itertools import count
from types import SimpleNamespace

import msgspec
import pytest

from dualbrain.adaptation.adapters.base_models import BaseModel
from dualbrain.adaptation.adapters.card import WEIGHTS_FILE, AdapterCard, read_adapter_card, write_adapter_card
from dualbrain.adaptation.adapters.card import has_foreign_proposals as by_others
from dualbrain.adaptation.adapters.packaged import packaged_folder
from dualbrain.adaptation.adapters.stacking import AdapterLayer, AdapterStack
from dualbrain.adaptation.curation.dataset import read_dataset
from dualbrain.adaptation.synthetic.split import SCENE_SEEDS
from dualbrain.runtime.data_collection import rollouts as room
from dualbrain.runtime.data_collection.rollouts import instruction_of, is_declined, memory_id_of_turn
from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples
from experiments.adaptation import round_chain as steps
from experiments.adaptation import rounds, suite_adapters
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
PLACES = steps.N_PLACES


class Stopped(BaseException):
    """As if killed."""


@pytest.fixture(scope="module")
def small():
    """Few places and instructions, drawn once for all tests here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(steps, "N_PLACES", 20)
        patch.setattr(steps, "N_INSTRUCTIONS", 10)
        for drawn in (steps.held_out_places, steps.instructions):
            patch.setattr(steps, drawn.__name__, cache(drawn.__wrapped__))
        yield


def speaking(act, asked):
    """A model that proposes the same contract three times of four, and answers held-out questions rightly."""

    class Speaker:
        def __init__(self, stack):
            assert stack.layers

        def answer(self, question, chance):
            act()
            asked.append(question.prompt[-1]["content"])
            return CONTRACT if chance.seeds[0] % 4 else "no contract"

        def answers(self, questions):
            return [question.contract for question in questions]

    return Speaker


@pytest.fixture
def stage(small, monkeypatch):
    """Nobody answers, flies or fits; `left` counts down to the act at which all ends once."""
    here = SimpleNamespace(left=count(1), fits=[], asked=[])

    def act():
        if next(here.left) == 0:
            raise Stopped

    def carried_out(one, ledger, turn, *, cache):
        act()
        told = episode(
            memory_id_of_turn(turn),
            proposer=one.source,
            scene_summary=summary(number=turn),
            instruction=instruction_of(one),
        )
        if ledger.parent.name == "partial":
            write_ledger(ledger.parent, [told]).close()
        return told

    def adapt(data, config, base, judge, folder, *, tell, own, **others):
        act()
        here.fits.append((base.sha256, config, data.card.sources))
        for step in (1, 2):
            tell(SimpleNamespace(step=step))
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
                bootstrapped=by_others(card.sources, base.name, own),
                precision="float32",
                steps=2,
                held_out=None,
                config=config,
                versions={},
            ),
            folder / "adapter",
        )

    def stack_of(folder, cache):
        return AdapterStack("smollm2-135m-instruct", folder, (AdapterLayer(folder, read_adapter_card(folder)),))

    night = pytest.importorskip("dualbrain.adaptation.training.train", reason="the extra `adapt` is not installed")
    monkeypatch.setattr(night, "adapt", adapt)
    monkeypatch.setattr(room, "run_proposal", carried_out)
    monkeypatch.setattr(room, "EPISODES_PER_STEP", 4)
    told = {
        "carried_out": carried_out,
        "Speaker": speaking(act, here.asked),
        "stack_of": stack_of,
        "find_base": lambda name, cache: (
            BASE if name == BASE.name else BaseModel(name=name, gguf=cache, gguf_sha256="other")
        ),
    }
    for name, stub in told.items():
        monkeypatch.setattr(steps, name, stub)
    return here


def lived(folder, numbers=range(rounds.N_ROUNDS + 1)):
    """The rows of these rounds without the one thing that a clock tells."""
    told = [rounds.Rounds().run({"seed": 0, "round": number, "folder": str(folder)}) for number in numbers]
    assert all(row.pop("fit_s") > 0.0 for row in told if row["round"])
    return told


def test_nothing_that_is_held_out_is_ever_proposed_on(small):
    """Neither a scene nor a sentence; and no two rounds or chains are asked the same."""
    apart = steps.held_out_places()
    asked = [steps.instructions(seed, number) for seed in range(2) for number in range(rounds.N_ROUNDS)]
    every = [one for some in asked for one in some]
    assert not {one.scene for one in apart} & {one.scene for one in every}
    assert not {instruction_of(one).lower() for one in apart} & {instruction_of(one).lower() for one in every}
    assert all(int(one.scene.rpartition(":")[2]) in SCENE_SEEDS["test"] for one in apart)
    assert all(int(one.scene.rpartition(":")[2]) in SCENE_SEEDS["teach"] for one in every)
    assert len({one.prompt[-1]["content"] for one in every}) == len(every)
    assert any(map(is_declined, every))
    assert all(map(steps.has_one_goal, (*apart, *every)))
    assert len(apart) == steps.N_PLACES
    assert {len(some) for some in asked} == {steps.N_INSTRUCTIONS}


@pytest.mark.slow
def test_there_are_a_hundred_held_out_deeds():
    apart = generate_examples(PLACES, "test", steps.HELD_OUT_SEED, {"panda": 1.0}, exemplar_share=0.0)
    assert sum(not is_declined(one) for one in apart) >= 100


def test_only_the_model_proposes_and_every_fit_starts_from_the_base(stage, tmp_path):
    told = lived(tmp_path)
    cards = [read_adapter_card(tmp_path / "chain 0" / f"fit {number}" / "adapter") for number in (1, 2, 3)]
    names = ["base-135m", *(f"base-135m+{card.id[:16]}" for card in cards)]
    assert [sha for sha, _, _ in stage.fits] == [BASE.sha256] * 3
    assert [set(sources) for _, _, sources in stage.fits] == [set(names[: number + 1]) for number in range(3)]
    assert [row["adapter"] for row in told[1:]] == [card.id for card in cards]
    assert not any(row["bootstrapped"] for row in told[1:])
    assert [row["proposed"] for row in told[1:]] == [10, 20, 30]
    for number in (1, 2, 3):
        data = read_dataset(tmp_path / "chain 0" / f"fit {number}" / "dataset")
        assert not by_others(data.card.sources, "base-135m", [card.id for card in cards[: number - 1]])
        assert {instruction_of(one) for one in data.train} <= {
            instruction_of(one) for earlier in range(number) for one in steps.instructions(0, earlier)
        }


def test_what_leaves_a_part_out_is_fitted_on_the_same_flights(stage, tmp_path, monkeypatch):
    """Only the switch differs: data of the last round, steps, seed; without physical selection there is more of it."""
    found = []
    registry = SimpleNamespace(add=lambda folder, *, now: found.append(read_adapter_card(folder).id))
    monkeypatch.setattr(suite_adapters, "registry_of_adapters", lambda: registry)
    units = suite_adapters.SuiteAdapters().units(Options(tmp_path, "any"))
    rows = {unit.key: suite_adapters.SuiteAdapters().run(unit.parameters) for unit in units}
    configs = [config for _, config, _ in stage.fits[-5:]]
    assert set(rows) == {"adapted", *steps.ABLATIONS}
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


def test_what_somebody_else_proposed_teaches_nothing(tmp_path):
    others = [
        episode(f"e{i}", proposer=by, scene_summary=summary(number=i))
        for i, by in enumerate(("base-135m", "templates"))
    ]
    write_ledger(tmp_path, others).close()
    with pytest.raises(AssertionError, match="templates"):
        steps.select_training_data(tmp_path / room.LEDGER_FILE, ())


@pytest.mark.parametrize("after", [9, 30, 75])
def test_stopped_anywhere_the_rows_are_the_same(stage, tmp_path, after):
    whole = lived(tmp_path / "whole")
    stage.left = count(-after)
    with suppress(Stopped):
        lived(tmp_path / "again")
        pytest.fail("was not stopped")
    stage.asked.clear()
    assert lived(tmp_path / "again") == whole
    assert len(stage.asked) <= 30
    assert lived(tmp_path / "again") == whole


def test_rounds_may_be_asked_for_in_any_order(stage, tmp_path):
    assert lived(tmp_path / "one", (3, 1, 0, 2)) == lived(tmp_path / "other", (3, 1, 0, 2))
    assert (
        sorted(lived(tmp_path / "one", (2, 0)), key=lambda row: row["round"])[1] == lived(tmp_path / "other", (2,))[0]
    )


def test_declines_may_teach_only_where_nothing_could_be_done(small, tmp_path):
    every = [one for number in (0, 1) for one in steps.instructions(0, number)]
    named = steps.RoundChain(0, tmp_path).correct_declines(2)
    assert [is_declined(every[room.turn_of_memory_id(name)]) for name in named] == [True] * sum(map(is_declined, every))


def test_the_seconds_of_a_step_count_once(tmp_path):
    ticks = iter((0.0, 5.0, 7.0, 100.0, 103.0, 104.0))
    for steps_taken in ((1, 2), (2, 3)):
        with (tmp_path / "told").open("a") as told:
            tell = steps.step_time_logger(told, lambda: next(ticks))
            for step in steps_taken:
                tell(SimpleNamespace(step=step))
    assert steps.total_step_time(tmp_path / "told") == pytest.approx(5.0 + 3.0 + 1.0)


def row(number, told, **facts):
    """A row of episodes, one a place: (Δ or None, whether it was a success)."""
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
        for i, (size, good) in enumerate(told)
    ]
    taught = {
        "adapter": f"{number}" * 64,
        "bootstrapped": False,
        "proposed": 10,
        "samples": 4,
        "as_said": 3,
        "fit_s": 61.0,
        "left_out": {"outcome failed": 2},
    }
    return {"seed": 0, "round": number, "episodes": episodes, **(taught if number else {}), **facts}


ROWS = [
    row(0, [(None, True), (0.004, True), (0.002, False), (None, False)]),
    row(1, [(0.5, False), (0.003, True), (0.001, True), (0.001, True)]),
]


def test_tables_come_from_the_rows_and_compare_the_same_places():
    text = "\n".join(rounds.Rounds().report(ROWS))
    assert "| 0 | 1 | 4 | 50% (12% to 88%), n = 4 |" in text
    assert "| 1 | 1 | 4 | 100% (" in text
    assert rounds.format_difference("Δ of successes", ROWS[:1], ROWS[1:]).startswith("-0.0010 (")
    assert rounds.format_difference("Δ of successes", ROWS[:1], ROWS[1:]).endswith(", 1")  # only where both did it
    assert rounds.format_difference("declined what must be", ROWS[:1], ROWS[1:]).startswith("-100%")
    assert rounds.format_difference("time to completion [s]", ROWS[:1], ROWS[1:]) == "+0.0 (-inf to +inf), 1"
    assert "| 0 | 1 | 10 | 4 | 3 of 4 (" in text
    assert "2 outcome failed" in text
    again = msgspec.json.decode(msgspec.json.encode(ROWS))
    assert "\n".join(rounds.Rounds().report(again)) == text


def test_a_part_of_the_rounds_has_a_table_and_a_picture(tmp_path):
    for some in (ROWS, ROWS[:1], ROWS[1:]):
        assert "| round | chains | episodes |" in "\n".join(rounds.Rounds().report(some))
        plot_rounds(some, tmp_path / "x.png")
        assert (tmp_path / "x.png").stat().st_size > 1000


def test_an_episode_is_counted_as_the_evaluation_counts_it(small, monkeypatch):
    """What is to be declined succeeds if nothing moved; a deed if it is the right one, and the robot says so."""
    monkeypatch.setattr(steps, "carried_out", lambda one, ledger, turn, cache: flight)
    todo = [(turn, one) for turn, one in enumerate(steps.held_out_places()) if '"place"' not in one.contract]
    turn, deed = next(pair for pair in todo if not is_declined(pair[1]))
    other, refusal = next(pair for pair in todo if is_declined(pair[1]))
    for kind in ("succeeded", "failed"):
        flight = episode("x", kind, plan=pick_contract(), duration=8.0)
        flight = msgspec.structs.replace(flight, contract=json.loads(deed.contract))
        found = steps.run_held_out_episode(turn, deed.contract, "base-135m")
        assert (found["right"], found["success"]) == (True, kind == "succeeded")
        assert found["completion_s"] == 10.0
    wrong = steps.run_held_out_episode(turn, "nonsense", "base-135m")
    assert (wrong["outcome"], wrong["success"], wrong["Delta"]) == ("rejected", False, None)
    for text, outcome in ((refusal.contract, "declined"), ("nonsense", "rejected")):
        found = steps.run_held_out_episode(other, text, "base-135m")
        assert (found["outcome"], found["success"], found["to_decline"]) == (outcome, True, True)
        assert found["compliant"] == (outcome == "declined")
