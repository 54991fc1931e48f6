"""Contracts that succeeded in this place are reused: only if they fulfil the instruction, and only through the gate."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from math import pi

import msgspec
import pytest

from dualbrain.contracts.contract import Contract
from dualbrain.core.geometry.shapes import Pose
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.state.provenance import episode_provenance
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.records import Precedent
from dualbrain.robots.loader import load_robot
from dualbrain.runtime.agent import Agent, NoMemory
from dualbrain.runtime.inspection.counterfactual import CounterfactualQueries
from dualbrain.runtime.planning.planner_request import PlanningContext
from dualbrain.runtime.planning.planning_time import format_timings
from dualbrain.runtime.planning.reuse.reused_contract import (
    REUSED_CONTRACT,
    find_reusable,
    is_reused,
)
from dualbrain.runtime.session import RunObserver, Session
from dualbrain.skills.registry import skill_registry
from tests.grounding.perceived_scenes import bowl, box, scene
from tests.runtime.planning.test_replanning import PUSH, near_destination
from tests.stories.story_session import GRASP, PLACE, contract_text, decline_contract, make_clocks, run_config

CUBE_TO_BOWL = contract_text(("grasp", GRASP), ("place", PLACE))
INSTRUCTION = "put the red cube in the blue bowl"


def context(*objects, holding=None):
    things = objects or (box("red_cube", 0.5, -0.2), box("green_box", 0.45, 0.1, (0.03, 0.02, 0.025)))
    perceived = scene(*things, bowl(), places=[("table_left", (0.5, 0.35, 0.0))])
    return PlanningContext(
        robot_model=load_robot("panda"), scene=perceived, holding=holding, posture=Posture((0.0,) * 7, 0.04)
    )


@dataclass
class PlaceMemory(NoMemory):
    """A memory that finds these precedents in every scene, and the outcomes of a contract among them."""

    precedents: list[Precedent] = field(default_factory=list)
    n_searches: int = 0

    def find_precedents(self, *arguments, **options):
        return tuple(one for one in self.precedents if one.evidence != "against")

    def find_outcomes(self, contract, *arguments, **options):
        self.n_searches += 1
        wanted = list(contract["action_sequence"])
        return tuple(one for one in self.precedents if one.contract.get("action_sequence") == wanted)


def precedent(contract=CUBE_TO_BOWL, situation=None, **changes):
    """A clean success in the place of `situation`."""
    where = situation or context()
    fields = {
        "episode_id": "e-1",
        "instruction": INSTRUCTION,
        "summary": "",
        "contract": json.loads(contract),
        "evidence": "clean",
        "Delta": 0.0,
        "weight": 0.575,
        "scene": where.scene,
        "q": where.posture.q,
    }
    return Precedent(**fields | changes)


def reuse(instruction=INSTRUCTION, *precedents, situation=None):
    """The actions that are reused for `instruction`; None if the planner is asked."""
    now = situation or context()
    memory = PlaceMemory(list(precedents or (precedent(situation=now),)))
    found = find_reusable(instruction, now, memory, "c-0001")
    if found is None:
        return None
    exemplar, proposal = found
    assert exemplar.succeeded
    contract = msgspec.json.decode(proposal.text, type=Contract)
    assert (contract.id, contract.context.robot, proposal.planner) == ("c-0001", "panda", REUSED_CONTRACT)
    return [(action.skill, action.params) for action in contract.action_sequence]


def test_the_contract_that_succeeded_here_answers_the_same_request_in_other_words():
    expected = [("grasp", GRASP), ("place", PLACE)]
    assert reuse() == expected
    assert reuse("move the red cube into the bowl") == expected
    assert reuse("could you please pick up the red cube and put it in the blue bowl?") == expected


@pytest.mark.parametrize(
    ("evidence", "is_reused_then"),
    [
        (["clean"], True),
        (["clean", "clean", "unclean"], True),
        (["clean", "unconfirmed"], True),
        (["clean", "unclean"], False),
        (["unclean"], False),
        (["unconfirmed"], False),
        (["against"], False),
        (["clean", "clean", "clean", "against"], False),
    ],
)
def test_a_contract_needs_more_clean_than_unclean_outcomes_here_and_none_against_it(evidence, is_reused_then):
    outcomes = [precedent(evidence=one) for one in evidence]
    assert (reuse(INSTRUCTION, *outcomes) is not None) == is_reused_then


def test_the_outcomes_of_a_contract_are_read_once():
    memory = PlaceMemory([*[precedent()] * 20, precedent(evidence="against")])
    assert find_reusable(INSTRUCTION, context(), memory, "c-0001") is None
    assert memory.n_searches == 1


def test_another_contract_is_reused_after_a_failure_of_the_first():
    other = contract_text(("grasp", GRASP | {"clearance": 0.15}), ("place", PLACE))
    grasp, _ = reuse(INSTRUCTION, precedent(), precedent(evidence="against"), precedent(other, Delta=0.002))
    assert grasp[1]["clearance"] == 0.15


MOVED = box("red_cube", 0.53, -0.2), box("green_box", 0.45, 0.1, (0.03, 0.02, 0.025))


def test_outcomes_in_another_place_count_neither_for_nor_against():
    elsewhere = context(*MOVED)
    assert reuse(INSTRUCTION, precedent(), precedent(situation=elsewhere, evidence="against")) is not None
    assert reuse(INSTRUCTION, precedent(situation=elsewhere)) is None
    unclean = [precedent(evidence="unclean"), *[precedent(situation=elsewhere)] * 5]
    assert reuse(INSTRUCTION, *unclean) is None


def test_a_success_from_another_posture_does_not_count():
    assert reuse(INSTRUCTION, precedent(q=(0.2, *context().posture.q[1:]))) is None


def test_the_contract_with_the_smallest_intervention_is_taken():
    speeds = [contract_text(("grasp", GRASP | {"speed": speed}), ("place", PLACE)) for speed in (0.1, 0.2, 0.3)]
    outcomes = [precedent(text, Delta=Delta) for text, Delta in zip(speeds, (0.002, 0.0, 0.001), strict=True)]
    grasp, _ = reuse(INSTRUCTION, *outcomes)
    assert grasp[1]["speed"] == 0.2


def test_more_care_than_asked_is_reused_and_less_is_not():
    careful = precedent(instruction=f"carefully {INSTRUCTION}")
    assert reuse(INSTRUCTION, careful) is not None
    assert reuse(f"carefully {INSTRUCTION}", careful) is not None
    assert reuse(f"carefully {INSTRUCTION}", precedent()) is None
    assert reuse(f"very slowly {INSTRUCTION}", precedent(instruction=f"slowly {INSTRUCTION}")) is None


@pytest.mark.parametrize(
    "instruction",
    [
        "put the red cube in the blue bowl, then go home",
        "put the red cube and the green box in the blue bowl",
        "do not put the red cube in the blue bowl",
        "push the red cube toward the blue bowl",
        "put the purple cube in the blue bowl",
        "sing a song about the red cube",
        "slowly put the red cube in the blue bowl",
        "put the red cube in the blue bowl and wait 10 seconds",
        "put the red cube gently in the blue bowl",
        "hit the person with the red cube",
    ],
)
def test_a_contract_that_does_not_carry_out_the_instruction_is_not_reused(instruction):
    assert reuse(instruction) is None


BOTH = "put the red cube and the green box in the blue bowl"
RELEASE = ("release", {"speed": 0.1})


@pytest.mark.parametrize(
    ("instruction", "actions"),
    [
        (INSTRUCTION, [RELEASE]),
        ("put the green box on the left side of the table", [RELEASE]),
        (INSTRUCTION, [RELEASE, ("grasp", GRASP), ("place", PLACE)]),
        (INSTRUCTION, [("grasp", {}), ("place", PLACE)]),
        (BOTH, [("grasp", GRASP | {"object": "table_left"}), ("place", PLACE), ("grasp", GRASP), ("place", PLACE)]),
        (BOTH, [("grasp", GRASP | {"object": "gone"}), ("place", PLACE), ("grasp", GRASP), ("place", PLACE)]),
        (INSTRUCTION, [("juggle", {"object": "red_cube"}), ("grasp", GRASP), ("place", PLACE)]),
        (INSTRUCTION, [("home", {"speed": 0.2})]),
    ],
)
def test_a_contract_that_releases_nothing_or_is_not_possible_here_is_not_reused(instruction, actions):
    assert reuse(instruction, precedent(contract_text(*actions), instruction=instruction)) is None


def test_an_object_that_may_be_at_its_destination_is_put_there():
    """Perception cannot decide whether a cube on the rim is in the bowl, and a contract that goes home leaves it."""
    rim = box("red_cube", 0.5, 0.20, z=0.03)
    home = contract_text(("home", {"speed": 0.2}))
    words = "put the red cube in the blue bowl, then go home"
    assert reuse(words, precedent(home, context(rim), instruction=words), situation=context(rim)) is None


def test_an_amount_is_reused_for_the_same_words_only():
    push = contract_text(("push", PUSH | {"distance": 0.1}))
    words = "push the red cube toward the blue bowl by 10 cm"
    assert reuse(words, precedent(push, instruction=words)) is not None
    assert reuse(words.replace("10", "5"), precedent(push, instruction=words)) is None


PUSHED = "push the green box toward the blue bowl"
STEPS = {"grasp": GRASP, "place": PLACE, "home": {"speed": 0.2}, "hold": {"duration": 10.0}, "push": PUSH}


@pytest.mark.parametrize(
    ("words", "remembered", "skills"),
    [
        (f"{INSTRUCTION}, then go home", f"go home, then {INSTRUCTION}", "home grasp place"),
        (f"{INSTRUCTION}, then wait 10 seconds", f"wait 10 seconds, then {INSTRUCTION}", "hold grasp place"),
        (f"{INSTRUCTION}, then go home", f"{INSTRUCTION}, then go home", "grasp place home"),
        (
            f"push the green box toward the blue bowl, then {INSTRUCTION}",
            f"{INSTRUCTION}, then push it",
            "grasp place push",
        ),
        (BOTH, BOTH, "grasp place grasp place"),
        (INSTRUCTION, INSTRUCTION, "hold grasp place"),
    ],
)
def test_requests_of_several_steps_are_left_to_the_planner(words, remembered, skills):
    """The order of the steps, and the step to which a manner belongs, would have to be compared."""
    contract = contract_text(*((skill, STEPS[skill]) for skill in skills.split()))
    assert reuse(words, precedent(contract, instruction=remembered)) is None


def test_an_object_with_a_new_name_is_named_so_and_failures_under_either_name_count():
    now = context(box("crimson_cube", 0.5, -0.2), box("green_box", 0.45, 0.1, (0.03, 0.02, 0.025)))
    words = "put the crimson cube in the blue bowl"
    grasp, place = reuse(words, precedent(), situation=now)
    assert grasp[1] == GRASP | {"object": "crimson_cube"}
    assert place[1] == PLACE
    renamed = contract_text(("grasp", GRASP | {"object": "crimson_cube"}), ("place", PLACE))
    for failure in (precedent(evidence="against"), precedent(renamed, now, evidence="against")):
        assert reuse(words, precedent(), failure, situation=now) is None


def test_another_object_of_the_same_place_is_left_to_the_planner():
    """The evidence is that of one contract for one object."""
    assert reuse("put the green box in the blue bowl") is None


def test_a_cube_that_was_turned_by_ninety_degrees_is_left_to_the_planner():
    """The fingers would close along the other axis, toward its neighbour."""
    turned = context(box("red_cube", 0.5, -0.2, yaw=pi / 2), box("green_box", 0.45, 0.1, (0.03, 0.02, 0.025)))
    assert reuse(INSTRUCTION, precedent(), situation=turned) is None


def test_a_full_hand_leaves_the_answer_to_the_planner():
    full = context(holding="green_box")
    assert reuse(INSTRUCTION, precedent(situation=full), situation=full) is None


def test_malformed_contracts_scenes_and_declines_are_skipped():
    malformed = precedent(contract=json.dumps({"action_sequence": "x"}))
    cube = box("red_cube", 0.5, -0.2)
    broken = msgspec.structs.replace(cube, pose=Pose(cube.pose.position, (0.0, 0.0, 0.0, 0.0)))
    no_place = precedent(scene=context(broken, MOVED[1]).scene)
    declines = precedent(decline_contract())
    assert reuse(INSTRUCTION, malformed, no_place, declines, precedent()) == [("grasp", GRASP), ("place", PLACE)]
    assert reuse(INSTRUCTION, malformed, no_place, declines) is None


# --- in an episode ------------------------------------------------------------------------------------------------


@dataclass
class FixedMemory(PlaceMemory):
    """Clean successes of the `contracts` (text, instruction) in the place of the first episode stored in `place`.

    It keeps what it is to store, so that a memory without contracts learns the place.
    """

    contracts: tuple[tuple[str, str], ...] = ()
    place: FixedMemory | None = None
    stored: list = field(default_factory=list)

    def find_precedents(self, *arguments, **options):
        episode, state = self.place.stored[0]
        self.precedents = [
            precedent(text, instruction=words, scene=episode.scene, q=state.q) for text, words in self.contracts
        ]
        return super().find_precedents()

    def store(self, episode, state, *, now, image=None):
        self.stored.append((episode, state))
        return super().store(episode, state, now=now, image=image)


def seen_place(config):
    """A memory with one episode in the place of `config`, in which nothing moved."""
    memory, planner = FixedMemory(), ScriptedPlanner((decline_contract(),))
    first = replace(config, out=config.out.with_name("first"), reuse_contracts=False, tries=1)
    with Session(first, make_clocks(), {}, planner, agent=Agent(planner, memory)) as session:
        session.run(RunObserver())
    return memory


def home(speed):
    return contract_text(("home", {"speed": speed}))


def run_home(folder, remembered, *answers, **changes):
    """An episode with the instruction to go home, and the number of requests to the planner."""
    planner = ScriptedPlanner(answers)
    config = run_config(folder, instruction="go home", **{"reuse_contracts": True} | changes)
    memory = FixedMemory(contracts=((remembered, "go home"),), place=seen_place(config))
    with Session(config, make_clocks(), {}, planner, agent=Agent(planner, memory)) as session:
        episode = session.run(RunObserver()).episode
    assert [one for one, _ in memory.stored] == [episode]
    if config.reuse_contracts:
        assert CounterfactualQueries(planner, skill_registry(load_robot("panda")), folder).memory_uses(episode) == ()
    first = "c-0002" if config.reuse_contracts else "c-0001"
    assert [request.contract_id for request in planner.requests] == [first] * len(planner.requests)
    assert all(request.rejection is None for request in planner.requests), "the planner did not make that contract"
    return episode, len(planner.requests)


def test_the_planner_is_not_asked_and_the_author_is_recorded(tmp_path):
    episode, n_requests = run_home(tmp_path, home(0.2), home(0.1))
    assert (episode.outcome.kind, n_requests) == ("succeeded", 0)
    assert is_reused(episode)
    assert [one.episode_id for one in episode.recall.exemplars] == ["e-1"], "the memory that the contract follows"
    assert episode.contract["action_sequence"][0]["params"] == {"speed": 0.2}
    assert episode.timings["decision"] < 1.0
    assert "search for a contract of this place" in format_timings(episode.timings)
    assert "planner" not in format_timings(episode.timings)
    stored = json.loads((tmp_path / "run" / "config.json").read_bytes())
    assert stored["reuse_contracts"] is True


def test_a_reused_contract_that_the_gate_rejects_is_followed_by_the_planner(tmp_path):
    episode, n_requests = run_home(tmp_path, home(9.0), home(0.1))
    assert (episode.outcome.kind, n_requests) == ("succeeded", 1)
    rejected, accepted = episode.attempts
    assert rejected.proposal.planner == REUSED_CONTRACT
    assert rejected.verdict.pointer == "/action_sequence/0/params/speed"
    assert (accepted.proposal.planner, is_reused(episode)) == ("scripted", False)
    assert [attempt["verdict"]["verdict"] for attempt in msgspec.to_builtins(episode.attempts)] == [
        "rejected",
        "accepted",
    ]


def test_after_a_contract_that_failed_the_planner_is_asked(tmp_path):
    """The cube is nearer to its destination than the remembered push is long."""
    far = contract_text(("push", {**PUSH, "destination": "table_right", "distance": 0.25}))
    config = near_destination(tmp_path, tries=2, reuse_contracts=True)
    planner = ScriptedPlanner((decline_contract(),))
    memory = FixedMemory(contracts=((far, config.instruction),), place=seen_place(config))
    agent = Agent(planner, memory)
    with Session(config, make_clocks(), {}, planner, agent=agent) as session:
        result = session.run(RunObserver())
    assert [(one.outcome.kind, is_reused(one)) for one in result.earlier_episodes] == [("failed", True)]
    assert (result.episode.outcome.kind, is_reused(result.episode)) == ("declined", False)
    assert planner.requests[0].failure_feedback is not None


def test_a_stop_before_the_proposal_prevents_it(tmp_path):
    planner = ScriptedPlanner((home(0.1),))

    class StoppingMemory(FixedMemory):
        def find_precedents(self, *arguments, **options):
            session.interrupt()
            return super().find_precedents(*arguments, **options)

    config = run_config(tmp_path, instruction="go home", reuse_contracts=True)
    memory = StoppingMemory(contracts=((home(0.2), "go home"),), place=seen_place(config))
    with Session(config, make_clocks(), {}, planner, agent=Agent(planner, memory)) as session:
        episode = session.run(RunObserver()).episode
    assert (episode.outcome.kind, episode.attempts) == ("aborted", ())


def test_the_author_of_a_reused_contract_is_one_source_with_every_adapter(tmp_path):
    episode, _ = run_home(tmp_path, home(0.2), home(0.1))
    adapted = msgspec.structs.replace(episode, versions={**episode.versions, "adapter": "a" * 64})
    assert (episode_provenance(adapted).source, episode_provenance(adapted).adapter) == (REUSED_CONTRACT, "")


def test_by_default_the_planner_is_asked(tmp_path):
    episode, n_requests = run_home(tmp_path, home(0.2), home(0.1), reuse_contracts=False)
    assert (n_requests, is_reused(episode)) == (1, False)
    assert "reuse_contracts" not in json.loads((tmp_path / "run" / "config.json").read_bytes())


def test_a_confirmed_success_is_reused_by_the_next_run_in_other_words(tmp_path):
    """With the ledger, the senses and the gate of a run: the second run asks no planner."""
    planner = ScriptedPlanner((CUBE_TO_BOWL,))
    words = ("put the red cube in the blue bowl", "could you please move the red cube into the bowl?")
    episodes = []
    for number, instruction in enumerate(words):
        config = run_config(tmp_path, f"run-{number}", instruction=instruction, reuse_contracts=True)
        with Session(config, make_clocks(), {}, planner) as session:
            episodes.append(session.run(RunObserver()).episode)
    assert [one.outcome.kind for one in episodes] == ["succeeded", "succeeded"]
    assert [is_reused(one) for one in episodes] == [False, True]
    assert len(planner.requests) == 1
    assert episodes[1].contract["action_sequence"] == episodes[0].contract["action_sequence"]
