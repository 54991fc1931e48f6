"""Template planner, adversary, corrupted prompts, few-shot prompts, cached answers and the plan stage."""

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
from dualbrain.evaluation.planners.few_shot import BEST_FIXED, NO_CHANGE, FewShotPlanner, with_example
from dualbrain.evaluation.planners.template import TemplatePlanner, match_name
from dualbrain.evaluation.protocol.method import METHODS
from dualbrain.evaluation.protocol.suite import load_suite, parse_suite
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
INSTRUCTIONS = {"panda": "Could you move that little red block into the blue bowl?", "base": "go to the shelf"}


def request(robot="panda", instruction="", **values):
    registry, names = load_skill_registry(robot), NAMES[robot]
    return PlanRequest(
        instruction=instruction or INSTRUCTIONS[robot],
        scene="robot panda\nred_cube: object, tight, near_edge\nperson: none\nplaces: x",
        recall=values.get("recall", RetrievedContext()),
        robot=robot,
        registry_hash=registry.hash,
        skills_text=describe_skills(registry, names),
        schema=decoding_schema(registry, names),
        contract_id="c-0001",
    )


def check(robot, text):
    registry = load_skill_registry(robot)
    gate = Gate(registry, planner_grants(registry))
    return gate.check(text.encode(), names=NAMES[robot], principal=PLANNER, now=0.0)


@pytest.mark.parametrize("robot", ["panda", "base"])
def test_a_template_is_a_valid_contract_for_the_instruction(robot):
    for seed in range(20):
        verdict = check(robot, TemplatePlanner(seed).propose(request(robot)).text)
        assert isinstance(verdict, Accepted)
        names = [verdict.contract.action_sequence[0].params.get(name) for name in ("object", "place")]
        assert {"panda": "red_cube", "base": "shelf"}[robot] in names


def test_a_template_depends_on_the_seed_only():
    texts = {TemplatePlanner(seed).propose(request()).text for seed in (0, 0, 1, 2)}
    assert len(texts) == 3


def test_an_unknown_object_is_declined():
    text = TemplatePlanner().propose(request(instruction="put the spoon in the drawer")).text
    assert json.loads(text)["action_sequence"][0]["skill"] == "decline"
    assert match_name("the cube", ["red_cube", "blue_cube"]) is None


def test_a_template_mostly_copies_parameters_of_the_first_exemplar_but_never_its_object():
    contract = json.loads(TemplatePlanner(99).propose(request()).text)
    contract["action_sequence"][0]["params"] |= {"object": "clear_glass", "speed": 0.123}
    exemplar = Exemplar(
        episode_id="e",
        instruction="x",
        summary="y",
        contract=contract,
        succeeded=True,
        Delta=0.001,
        similarity=0.9,
        weight=0.5,
        score=0.8,
        rank=1,
    )
    n_copied = 0
    for seed in range(60):
        actions = json.loads(TemplatePlanner(seed).propose(request(recall=RetrievedContext((exemplar,)))).text)[
            "action_sequence"
        ]
        assert actions[0]["params"]["object"] == "red_cube"
        n_copied += actions[0]["params"]["speed"] == 0.123
    assert 38 <= n_copied <= 57


@pytest.mark.parametrize("robot", ["panda", "base"])
def test_every_attack_is_rejected_or_valid(robot):
    """A contract of the adversary is either rejected at a stage or within all bounds."""
    stages = set()
    for seed in range(60):
        proposal = Adversary(seed).propose(request(robot))
        verdict = check(robot, proposal.text)
        stages.add("" if isinstance(verdict, Accepted) else verdict.stage)
        assert proposal.planner.startswith("adversary (")
    assert stages == {"", "authorization", "envelope"}


def test_a_corrupted_prompt_keeps_its_schema():
    original = request()
    for how in ("shortened", "truncated", "overwritten"):
        corrupted = corrupt_prompt(original, how)
        assert corrupted != original
        assert (corrupted.schema, corrupted.contract_id, corrupted.registry_hash) == (
            original.schema,
            original.contract_id,
            original.registry_hash,
        )
    assert "tight" not in corrupt_prompt(original, "shortened").scene
    assert "places" not in corrupt_prompt(original, "truncated").scene
    assert corrupt_prompt(original, "overwritten").instruction.endswith(original.instruction)
    assert CorruptedPromptPlanner(ScriptedPlanner(["{}"]), "truncated").name == "scripted, prompt truncated"


def test_a_request_is_sent_once_by_all_processes(tmp_path):
    inner = ScriptedPlanner(["first", "second"])
    one = CachingPlanner("it", AnswerCache(tmp_path), lambda: inner)
    two = CachingPlanner("it", AnswerCache(tmp_path), lambda: inner)
    assert [planner.propose(request()).text for planner in (one, one, two)] == ["first"] * 3
    assert (one.n_requests, two.n_requests, len(inner.requests)) == (1, 0, 1)
    assert two.propose(request(instruction="another instruction")).text == "second"


class BatchPlanner:
    """A planner that answers batches of requests; records the batches."""

    name = "batch"

    def __init__(self):
        self.batches = []

    def propose(self, request):
        return self.propose_all([request])[0]

    def propose_all(self, requests):
        self.batches.append([one.instruction for one in requests])
        return [TemplatePlanner().propose(one) for one in requests]

    def close(self):
        pass


def test_the_plan_stage_sends_a_run_in_batches_and_episodes_reuse_its_answers(tmp_path):
    planner = BatchPlanner()
    sources = SimpleNamespace(open=lambda name, robot, *, constrained=True: planner)
    suite = msgspec.structs.replace(parse_suite(SUITE, "tiny.toml"), planners={"base": "batch"})
    units = build_units(suite, "plan")
    assert {unit.method for unit in units} == {"B1"}  # the answers are the same for all methods without memory
    worker = Worker(WorkerConfig(suite=suite, out=tmp_path, sources=sources, clock=time.perf_counter, epsilon={}))
    unit = units[0]
    first, *_ = lines = list(worker(unit))
    assert [line["key"] for line in lines] == [unit.row_key(order) for order in range(unit.n_episodes)]
    assert {line["asked"] for line in lines} == {1}
    assert [len(batch) for batch in planner.batches] == [unit.n_episodes]
    assert [line["asked"] for line in worker(msgspec.structs.replace(unit, done=1))] == [0] * (unit.n_episodes - 1)
    episode_unit = next(one for one in build_units(suite, "fly") if one.method == "B1" and one.cluster == unit.cluster)
    (row,) = worker(episode_unit)
    assert not row["asked"]
    assert len(planner.batches) == 1
    assert first["planner_s"] > 0.0


def test_a_kill_in_the_plan_stage_loses_only_the_current_batch(tmp_path, monkeypatch):
    monkeypatch.setattr("dualbrain.evaluation.runner.worker.PLAN_BATCH_SIZE", 2)
    planner = BatchPlanner()
    sources = SimpleNamespace(open=lambda name, robot, *, constrained=True: planner)
    suite = msgspec.structs.replace(parse_suite(SUITE, "tiny.toml"), planners={"base": "batch"}, runs=1, repetitions=1)
    worker = Worker(WorkerConfig(suite=suite, out=tmp_path, sources=sources, clock=time.perf_counter, epsilon={}))
    (unit,) = build_units(suite, "plan")
    assert unit.n_episodes == 4
    lines = worker(unit)
    assert [next(lines)["key"], next(lines)["key"]] == [unit.row_key(0), unit.row_key(1)]
    assert [len(batch) for batch in planner.batches] == [2]
    rest = list(Worker(worker._config)(msgspec.structs.replace(unit, done=2)))
    assert [line["key"] for line in rest] == [unit.row_key(2), unit.row_key(3)]
    assert [len(batch) for batch in planner.batches] == [2, 2]
    assert [line["key"] for line in Worker(worker._config)(unit)] == [unit.row_key(order) for order in range(4)]


@pytest.mark.parametrize("wrap", [FewShotPlanner, lambda inner: CorruptedPromptPlanner(inner, "truncated")])
def test_a_wrapper_changes_every_request_of_a_batch(wrap):
    planner = BatchPlanner()
    requests = [request(instruction=one) for one in ("put the cube in the bowl", "take the glass")]
    together = propose_all(wrap(planner), requests)
    assert [len(batch) for batch in planner.batches] == [2]
    assert together == [wrap(TemplatePlanner()).propose(one) for one in requests]
    assert propose_all(TemplatePlanner(), requests) == [TemplatePlanner().propose(one) for one in requests]


def test_answers_are_cached_by_planner_and_prompt(tmp_path):
    plans = AnswerCache(tmp_path)
    for id, instruction in (("a", ""), ("b", ""), ("a", "other")):
        CachingPlanner(id, plans, lambda text=f"{id}{instruction}": ScriptedPlanner([text])).propose(
            request(instruction=instruction)
        )
    assert sorted(cached.proposal.text for cached in plans.read_all()) == ["a", "aother", "b"]


def test_a_crash_is_not_cached(tmp_path):
    broken = CachingPlanner("it", AnswerCache(tmp_path), lambda: ScriptedPlanner([""], finish_reason=CRASHED))
    broken.propose(request())
    assert AnswerCache(tmp_path).read_all() == []


def test_a_cached_proposal_is_unchanged(tmp_path):
    proposal = TemplatePlanner().propose(request())
    AnswerCache(tmp_path).put("it", request(), proposal)
    assert AnswerCache(tmp_path).get("it", request()) == proposal
    assert msgspec.json.encode(proposal)


@pytest.mark.parametrize("robot", ["panda", "base"])
def test_the_example_of_the_few_shot_prompt_has_the_schema_of_a_contract(robot):
    inner = ScriptedPlanner(["{}"])
    planner = FewShotPlanner(inner)
    planner.propose(request(robot))
    exemplars = inner.requests[0].recall.exemplars
    assert len(exemplars) == 1
    registry = load_skill_registry(robot)
    for one in exemplars:
        assert one.succeeded
        assert one.contract["action_sequence"][0]["skill"] != "decline"
        for action in one.contract["action_sequence"]:
            spec = registry.skill(action["skill"])
            assert set(action["params"]) == {parameter.name for parameter in spec.parameters}
    text = render_short("", "", robot=robot, registry="", contract_id="", exemplars=exemplars)[1]["content"]
    assert text.count("<example>") == 1
    assert planner.name == "scripted, with a worked example"


@pytest.mark.parametrize("robot", ["panda", "base"])
def test_the_fixed_example_has_other_parameters_and_nothing_else(robot):
    usual, fixed = (with_example(request(robot), values).recall.exemplars[0] for values in (NO_CHANGE, BEST_FIXED))
    assert msgspec.structs.replace(fixed, contract=usual.contract) == usual
    pairs = zip(usual.contract["action_sequence"], fixed.contract["action_sequence"], strict=True)
    for before, after in pairs:
        assert (before["skill"], before["params"].keys()) == (after["skill"], after["params"].keys())
        for name, value in after["params"].items():
            assert value == BEST_FIXED.get(name, before["params"][name])
    if robot == "panda":
        assert fixed.contract != usual.contract
    assert with_example(request(robot)).recall.exemplars[0] == usual, "the example itself is unchanged"


def test_the_fixed_example_has_answers_of_its_own(tmp_path):
    suite = load_suite("adaptation")
    factory = PlannerFactory(suite, PlannerSources(tmp_path, tmp_path), AnswerCache(tmp_path))
    names = {name: factory.get(METHODS[name], "panda").id for name in ("B3", "PE", "PE-fixed")}
    assert len(set(names.values())) == 3
    assert FewShotPlanner(ScriptedPlanner([]), BEST_FIXED).name == "scripted, with a worked example of fixed parameters"


def test_retrieved_exemplars_are_not_replaced_by_the_example():
    original = request(
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
    assert with_example(original) == original


def test_answers_are_cached_by_prompt_wrapper_and_constraint(tmp_path):
    suite = parse_suite(SUITE.replace(b'base = "template"', b'base = "base-135m"\nprompted = "base-135m"'), "tiny.toml")
    planners = PlannerFactory(suite, PlannerSources(tmp_path, tmp_path), AnswerCache(tmp_path))
    methods = [METHODS[name] for name in ("B3", "PE", "PE-shortened")]
    ids = [planners.get(method, "panda").id for method in methods]
    ids += [planners.get_unconstrained(method, "panda").id for method in methods]
    assert ids[:3] == [
        "base-135m",
        "base-135m, with a worked example",
        "base-135m, with a worked example, prompt shortened",
    ]
    assert ids[3:] == [f"{id}, bound by nothing" for id in ids[:3]]
    assert planners.get(METHODS["M"], "panda") is planners.get(METHODS["B3"], "panda")


def test_random_planners_have_no_unconstrained_variant(tmp_path):
    planners = PlannerFactory(
        parse_suite(SUITE, "tiny.toml"), PlannerSources(tmp_path, tmp_path), AnswerCache(tmp_path)
    )
    assert planners.get_unconstrained(METHODS["B3"], "panda") is None
    assert planners.get_unconstrained(METHODS["A1"], "panda") is None
