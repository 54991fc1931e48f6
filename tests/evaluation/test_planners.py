"""Planners that are drawn, spoiled prompts, and answers that are kept."""

import json
import time
from types import SimpleNamespace

import msgspec
import pytest

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.schema import decoding_schema, describe_skills
from dualbrain.contracts.verdict import Accepted
from dualbrain.evaluation.planners.adversary import Adversary
from dualbrain.evaluation.planners.answer_cache import AnswerCache, CachingPlanner
from dualbrain.evaluation.planners.corrupted_prompt import CorruptedPromptPlanner, corrupt_prompt
from dualbrain.evaluation.planners.factory import PlannerFactory, PlannerSources
from dualbrain.evaluation.planners.few_shot import FewShotPlanner, with_example
from dualbrain.evaluation.planners.template import TemplatePlanner, match_name
from dualbrain.evaluation.protocol.method import METHODS
from dualbrain.evaluation.protocol.suite import parse_suite
from dualbrain.evaluation.runner.work_units import build_units
from dualbrain.evaluation.runner.worker import Worker, WorkerConfig
from dualbrain.grounding.vocabulary import load_skill_registry, planner_grants
from dualbrain.planner.prompt.short_prompt import render_short
from dualbrain.planner.protocol import CRASHED, propose_all
from dualbrain.planner.request import PlanRequest
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.records import Exemplar, RetrievedContext
from tests.evaluation.sample_rows import SUITE

NAMES = {
    "panda": SceneNames(("red_cube", "clear_glass"), ("blue_bowl", "table_left"), 1),
    "base": SceneNames((), ("shelf", "charger"), 1),
}
WORDS = {"panda": "Could you move that little red block into the blue bowl?", "base": "go to the shelf"}


def request(robot="panda", words="", **values):
    registry, names = load_skill_registry(robot), NAMES[robot]
    return PlanRequest(
        instruction=words or WORDS[robot],
        scene="robot panda\nred_cube: object, tight, near_edge\nperson: none\nplaces: x",
        recall=values.get("recall", RetrievedContext()),
        robot=robot,
        registry_hash=registry.hash,
        skills_text=describe_skills(registry, names),
        schema=decoding_schema(registry, names),
        contract_id="c-0001",
    )


def judged(robot, text):
    registry = load_skill_registry(robot)
    gate = Gate(registry, planner_grants(registry))
    return gate.check(text.encode(), names=NAMES[robot], principal=PLANNER, now=0.0)


@pytest.mark.parametrize("robot", ["panda", "base"])
def test_a_template_is_a_valid_contract_about_what_was_asked(robot):
    for seed in range(20):
        verdict = judged(robot, TemplatePlanner(seed).propose(request(robot)).text)
        assert isinstance(verdict, Accepted)
        named = [verdict.contract.action_sequence[0].params.get(name) for name in ("object", "place")]
        assert {"panda": "red_cube", "base": "shelf"}[robot] in named


def test_the_same_question_gets_the_same_answer_and_another_seed_another_one():
    texts = {TemplatePlanner(seed).propose(request()).text for seed in (0, 0, 1, 2)}
    assert len(texts) == 3


def test_what_is_not_there_is_declined():
    text = TemplatePlanner().propose(request(words="put the spoon in the drawer")).text
    assert json.loads(text)["action_sequence"][0]["skill"] == "decline"
    assert match_name("the cube", ["red_cube", "blue_cube"]) is None


def test_a_template_follows_the_first_exemplar_mostly_and_never_in_what_is_meant():
    shown = json.loads(TemplatePlanner(99).propose(request()).text)
    shown["action_sequence"][0]["params"] |= {"object": "clear_glass", "speed": 0.123}
    exemplar = Exemplar(
        episode_id="e",
        instruction="x",
        summary="y",
        contract=shown,
        succeeded=True,
        Delta=0.001,
        similarity=0.9,
        weight=0.5,
        score=0.8,
        rank=1,
    )
    followed = 0
    for seed in range(60):
        actions = json.loads(TemplatePlanner(seed).propose(request(recall=RetrievedContext((exemplar,)))).text)[
            "action_sequence"
        ]
        assert actions[0]["params"]["object"] == "red_cube"
        followed += actions[0]["params"]["speed"] == 0.123
    assert 38 <= followed <= 57


@pytest.mark.parametrize("robot", ["panda", "base"])
def test_every_attack_is_refused_or_harmless_in_form(robot):
    """What the adversary writes is either refused at a named stage, or inside every bound."""
    stages = set()
    for seed in range(60):
        proposal = Adversary(seed).propose(request(robot))
        verdict = judged(robot, proposal.text)
        stages.add("" if isinstance(verdict, Accepted) else verdict.stage)
        assert proposal.planner.startswith("adversary (")
    assert stages == {"", "authorization", "envelope"}


def test_a_spoiled_prompt_has_less_or_other_words_and_the_same_schema():
    whole = request()
    for how in ("shortened", "truncated", "overwritten"):
        spoiled = corrupt_prompt(whole, how)
        assert spoiled != whole
        assert (spoiled.schema, spoiled.contract_id, spoiled.registry_hash) == (
            whole.schema,
            whole.contract_id,
            whole.registry_hash,
        )
    assert "tight" not in corrupt_prompt(whole, "shortened").scene
    assert "places" not in corrupt_prompt(whole, "truncated").scene
    assert corrupt_prompt(whole, "overwritten").instruction.endswith(whole.instruction)
    assert CorruptedPromptPlanner(ScriptedPlanner(["{}"]), "truncated").name == "scripted, prompt truncated"


def test_a_question_is_asked_once_by_any_process(tmp_path):
    inner = ScriptedPlanner(["first", "second"])
    one = CachingPlanner("it", AnswerCache(tmp_path), lambda: inner)
    two = CachingPlanner("it", AnswerCache(tmp_path), lambda: inner)
    assert [planner.propose(request()).text for planner in (one, one, two)] == ["first"] * 3
    assert (one.n_requests, two.n_requests, len(inner.requests)) == (1, 0, 1)
    assert two.propose(request(words="another question")).text == "second"


class Crowd:
    """A planner that is quicker when many ask; it notes how many asked together."""

    name = "crowd"

    def __init__(self):
        self.asked = []

    def propose(self, request):
        return self.propose_all([request])[0]

    def propose_all(self, requests):
        self.asked.append([one.instruction for one in requests])
        return [TemplatePlanner().propose(one) for one in requests]

    def close(self):
        pass


def test_the_pass_of_questions_asks_a_run_together_and_a_flight_asks_the_same_question(tmp_path):
    crowd = Crowd()
    sources = SimpleNamespace(open=lambda name, robot, *, constrained=True: crowd)
    suite = msgspec.structs.replace(parse_suite(SUITE, "tiny.toml"), planners={"base": "crowd"})
    units = build_units(suite, "plan")
    assert {unit.method for unit in units} == {"B1"}  # whose answers are those of all others without memory
    work = Worker(WorkerConfig(suite=suite, out=tmp_path, sources=sources, clock=time.perf_counter, epsilon={}))
    unit = units[0]
    first, *_ = lines = list(work(unit))
    assert [line["key"] for line in lines] == [unit.row_key(order) for order in range(unit.n_episodes)]
    assert {line["asked"] for line in lines} == {1}
    assert [len(words) for words in crowd.asked] == [unit.n_episodes]
    assert [line["asked"] for line in work(msgspec.structs.replace(unit, done=1))] == [0] * (unit.n_episodes - 1)
    flying = next(one for one in build_units(suite, "fly") if one.method == "B1" and one.cluster == unit.cluster)
    (row,) = work(flying)
    assert not row["asked"]
    assert len(crowd.asked) == 1
    assert first["planner_s"] > 0.0


def test_of_the_pass_of_questions_a_kill_costs_only_those_under_way(tmp_path, monkeypatch):
    monkeypatch.setattr("dualbrain.evaluation.runner.worker.PLAN_BATCH_SIZE", 2)
    crowd = Crowd()
    sources = SimpleNamespace(open=lambda name, robot, *, constrained=True: crowd)
    suite = msgspec.structs.replace(parse_suite(SUITE, "tiny.toml"), planners={"base": "crowd"}, runs=1, repetitions=1)
    work = Worker(WorkerConfig(suite=suite, out=tmp_path, sources=sources, clock=time.perf_counter, epsilon={}))
    (unit,) = build_units(suite, "plan")
    assert unit.n_episodes == 4
    lines = work(unit)
    assert [next(lines)["key"], next(lines)["key"]] == [unit.row_key(0), unit.row_key(1)]
    assert [len(words) for words in crowd.asked] == [2]
    rest = list(Worker(work._config)(msgspec.structs.replace(unit, done=2)))
    assert [line["key"] for line in rest] == [unit.row_key(2), unit.row_key(3)]
    assert [len(words) for words in crowd.asked] == [2, 2]
    assert [line["key"] for line in Worker(work._config)(unit)] == [unit.row_key(order) for order in range(4)]


@pytest.mark.parametrize("dress", [FewShotPlanner, lambda inner: CorruptedPromptPlanner(inner, "truncated")])
def test_what_is_done_to_one_question_is_done_to_many(dress):
    crowd = Crowd()
    questions = [request(words=words) for words in ("put the cube in the bowl", "take the glass")]
    together = propose_all(dress(crowd), questions)
    assert [len(words) for words in crowd.asked] == [2]
    assert together == [dress(TemplatePlanner()).propose(one) for one in questions]
    assert propose_all(TemplatePlanner(), questions) == [TemplatePlanner().propose(one) for one in questions]


def test_another_planner_and_another_prompt_have_answers_of_their_own(tmp_path):
    plans = AnswerCache(tmp_path)
    for id, words in (("a", ""), ("b", ""), ("a", "other words")):
        CachingPlanner(id, plans, lambda text=f"{id}{words}": ScriptedPlanner([text])).propose(request(words=words))
    assert sorted(kept.proposal.text for kept in plans.read_all()) == ["a", "aother words", "b"]


def test_an_accident_is_not_kept(tmp_path):
    broken = CachingPlanner("it", AnswerCache(tmp_path), lambda: ScriptedPlanner([""], finish_reason=CRASHED))
    broken.propose(request())
    assert AnswerCache(tmp_path).read_all() == []


def test_a_proposal_comes_back_as_it_was(tmp_path):
    proposal = TemplatePlanner().propose(request())
    AnswerCache(tmp_path).put("it", request(), proposal)
    assert AnswerCache(tmp_path).get("it", request()) == proposal
    assert msgspec.json.encode(proposal)


@pytest.mark.parametrize("robot", ["panda", "base"])
def test_the_best_prompt_shows_examples_that_the_gate_would_read(robot):
    inner = ScriptedPlanner(["{}"])
    planner = FewShotPlanner(inner)
    planner.propose(request(robot))
    shown = inner.requests[0].recall.exemplars
    assert len(shown) == 1
    registry = load_skill_registry(robot)
    for one in shown:
        assert one.succeeded
        assert one.contract["action_sequence"][0]["skill"] != "decline"
        for action in one.contract["action_sequence"]:
            spec = registry.skill(action["skill"])
            assert set(action["params"]) == {parameter.name for parameter in spec.parameters}
    text = render_short("", "", robot=robot, registry="", contract_id="", exemplars=shown)[1]["content"]
    assert text.count("<example>") == 1
    assert planner.name == "scripted, with a worked example"


def test_what_memory_recalled_is_not_replaced_by_examples():
    asked = request(
        recall=RetrievedContext(
            (
                Exemplar(
                    episode_id="e",
                    instruction="x",
                    summary="y",
                    contract={"action_sequence": []},
                    succeeded=True,
                    Delta=0.001,
                    similarity=0.9,
                    weight=0.5,
                    score=0.8,
                    rank=1,
                ),
            )
        )
    )
    assert with_example(asked) == asked


def test_each_way_of_asking_has_answers_of_its_own(tmp_path):
    suite = parse_suite(SUITE.replace(b'base = "template"', b'base = "base-135m"\nprompted = "base-135m"'), "tiny.toml")
    planners = PlannerFactory(suite, PlannerSources(tmp_path, tmp_path), AnswerCache(tmp_path))
    arms = [METHODS[name] for name in ("B3", "PE", "PE-shortened")]
    ways = [planners.get(arm, "panda").id for arm in arms] + [
        planners.get_unconstrained(arm, "panda").id for arm in arms
    ]
    assert ways[:3] == [
        "base-135m",
        "base-135m, with a worked example",
        "base-135m, with a worked example, prompt shortened",
    ]
    assert ways[3:] == [f"{way}, bound by nothing" for way in ways[:3]]
    assert planners.get(METHODS["M"], "panda") is planners.get(METHODS["B3"], "panda")


def test_what_draws_its_answers_cannot_be_unbound(tmp_path):
    planners = PlannerFactory(
        parse_suite(SUITE, "tiny.toml"), PlannerSources(tmp_path, tmp_path), AnswerCache(tmp_path)
    )
    assert planners.get_unconstrained(METHODS["B3"], "panda") is None
    assert planners.get_unconstrained(METHODS["A1"], "panda") is None
