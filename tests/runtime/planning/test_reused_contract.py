"""Contracts of confident memories are reused: only if they fulfil the instruction, and only through the gate."""

import json
from dataclasses import dataclass, field

import msgspec
import pytest

from dualbrain.contracts.contract import Contract
from dualbrain.core.geometry.shapes import Pose
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.state.provenance import episode_provenance
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.records import Exemplar, RetrievedContext
from dualbrain.robots.loader import load_robot
from dualbrain.runtime.agent import Agent, NoMemory
from dualbrain.runtime.inspection.counterfactual import CounterfactualQueries
from dualbrain.runtime.planning.planner_request import PlanningContext
from dualbrain.runtime.planning.reused_contract import (
    MIN_SIMILARITY,
    MIN_WEIGHT,
    REUSED_CONTRACT,
    find_reusable,
    is_confident,
    is_reused,
)
from dualbrain.runtime.session import RunObserver, Session
from dualbrain.skills.registry import skill_registry
from tests.grounding.perceived_scenes import bowl, box, scene
from tests.runtime.planning.test_replanning import PUSH, near_destination
from tests.stories.story_session import GRASP, PLACE, contract_text, decline_contract, make_clocks, run_config

CUBE_TO_BOWL = contract_text(("grasp", GRASP), ("place", PLACE))
INSTRUCTION = "put the red cube in the blue bowl"


def exemplar(contract=CUBE_TO_BOWL, **changes):
    fields = {
        "episode_id": "e-1",
        "instruction": INSTRUCTION,
        "summary": "",
        "contract": json.loads(contract),
        "succeeded": True,
        "Delta": 0.0,
        "similarity": 0.99,
        "weight": 0.9,
        "score": 0.95,
        "rank": 1,
    }
    return Exemplar(**fields | changes)


def context(*objects, holding=None):
    things = objects or (box("red_cube", 0.5, -0.2), box("green_box", 0.45, 0.1, (0.03, 0.02, 0.025)))
    perceived = scene(*things, bowl(), places=[("table_left", (0.5, 0.35, 0.0))])
    return PlanningContext(
        robot_model=load_robot("panda"), scene=perceived, holding=holding, posture=Posture((0.0,) * 7, 0.04)
    )


def reuse(instruction=INSTRUCTION, *exemplars, situation=None):
    """The actions that are reused for `instruction`; None if the planner is asked."""
    recall = RetrievedContext(exemplars=exemplars or (exemplar(),))
    found = find_reusable(instruction, situation or context(), recall, "c-0001")
    if found is None:
        return None
    contract = msgspec.json.decode(found[1].text, type=Contract)
    assert (contract.id, contract.context.robot, found[1].planner) == ("c-0001", "panda", REUSED_CONTRACT)
    return [(action.skill, action.params) for action in contract.action_sequence]


def test_the_contract_of_a_confident_memory_answers_the_same_request_in_other_words():
    expected = [("grasp", GRASP), ("place", PLACE)]
    assert reuse() == expected
    assert reuse("move the red cube into the bowl") == expected


@pytest.mark.parametrize(
    "changes",
    [
        {"succeeded": False},
        {"weight": MIN_WEIGHT - 0.01},
        {"similarity": MIN_SIMILARITY - 0.01},
    ],
)
def test_a_memory_that_is_not_confident_is_not_reused(changes):
    assert not is_confident(exemplar(**changes))
    assert reuse(INSTRUCTION, exemplar(**changes)) is None


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
    assert reuse(instruction, exemplar(contract_text(*actions), instruction=instruction)) is None


def test_an_object_that_may_be_at_its_destination_is_put_there():
    """Perception cannot decide whether a cube on the rim is in the bowl, and a contract that goes home leaves it."""
    rim = box("red_cube", 0.5, 0.20, z=0.03)
    home = contract_text(("home", {"speed": 0.2}))
    words = "put the red cube in the blue bowl, then go home"
    assert reuse(words, exemplar(home, instruction=words), situation=context(rim)) is None


def test_an_amount_is_reused_for_the_same_words_only():
    push = contract_text(("push", PUSH | {"distance": 0.1}))
    words = "push the red cube toward the blue bowl by 10 cm"
    assert reuse(words, exemplar(push, instruction=words)) is not None
    assert reuse(words.replace("10", "5"), exemplar(push, instruction=words)) is None


def test_names_of_a_single_placement_are_adapted_and_the_opening_fits_the_new_object():
    narrow = contract_text(("grasp", GRASP | {"opening": 0.055}), ("place", PLACE))
    grasp, place = reuse("put the green box on the left side of the table", exemplar(narrow))
    assert (grasp[1]["object"], place[1]["destination"]) == ("green_box", "table_left")
    assert grasp[1]["opening"] == pytest.approx(0.075), "60 mm wide along its x axis"
    assert {key: value for key, value in grasp[1].items() if key not in ("object", "opening")} == {
        key: value for key, value in GRASP.items() if key not in ("object", "opening")
    }


def test_a_finger_axis_that_points_up_or_a_full_hand_leaves_the_answer_to_the_planner():
    standing = Pose((0.5, -0.2, 0.02), (0.5**0.5, 0.0, 0.5**0.5, 0.0))
    tilted = context(msgspec.structs.replace(box("red_cube", 0.5, -0.2), pose=standing))
    across = contract_text(("grasp", GRASP | {"finger_axis": "across"}), ("place", PLACE))
    assert reuse(situation=tilted) is None
    assert reuse(INSTRUCTION, exemplar(across), situation=tilted) is not None
    assert reuse(situation=context(holding="green_box")) is None


def test_the_first_confident_memory_that_fits_is_taken_and_malformed_ones_are_skipped():
    malformed = msgspec.structs.replace(exemplar(), contract={"action_sequence": "x"})
    declines = exemplar(decline_contract())
    assert reuse(INSTRUCTION, malformed, declines, exemplar()) == [("grasp", GRASP), ("place", PLACE)]
    assert reuse(INSTRUCTION, malformed, declines) is None


# --- in an episode ------------------------------------------------------------------------------------------------


@dataclass
class FixedMemory(NoMemory):
    """A memory that retrieves the given exemplars and keeps what it is to store."""

    exemplars: tuple[Exemplar, ...]
    stored: list = field(default_factory=list)

    def retrieve(self, *arguments, **options):
        return RetrievedContext(exemplars=self.exemplars)

    def store(self, episode, state, *, now, image=None):
        self.stored.append(episode)
        return super().store(episode, state, now=now, image=image)


def home(speed):
    return contract_text(("home", {"speed": speed}))


def run_home(folder, remembered, *answers, **changes):
    """An episode with the instruction to go home, and the number of requests to the planner."""
    planner = ScriptedPlanner(answers)
    memory = FixedMemory((exemplar(remembered, instruction="go home"),))
    config = run_config(folder, instruction="go home", **{"reuse_contracts": True} | changes)
    with Session(config, make_clocks(), {}, planner, agent=Agent(planner, memory)) as session:
        episode = session.run(RunObserver()).episode
    assert memory.stored == [episode]
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
    assert episode.contract["action_sequence"][0]["params"] == {"speed": 0.2}
    assert episode.timings["decision"] < 1.0
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
    agent = Agent(planner, FixedMemory((exemplar(far, instruction=config.instruction),)))
    with Session(config, make_clocks(), {}, planner, agent=agent) as session:
        result = session.run(RunObserver())
    assert [(one.outcome.kind, is_reused(one)) for one in result.earlier_episodes] == [("failed", True)]
    assert (result.episode.outcome.kind, is_reused(result.episode)) == ("declined", False)
    assert planner.requests[0].failure_feedback is not None


def test_a_stop_before_the_proposal_prevents_it(tmp_path):
    planner = ScriptedPlanner((home(0.1),))

    class StoppingMemory(FixedMemory):
        def retrieve(self, *arguments, **options):
            session.interrupt()
            return super().retrieve(*arguments, **options)

    memory = StoppingMemory((exemplar(home(0.2), instruction="go home"),))
    config = run_config(tmp_path, instruction="go home", reuse_contracts=True)
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
