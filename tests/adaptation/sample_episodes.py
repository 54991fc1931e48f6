"""Small episodes of the Panda, and ledgers of them, shared by the tests of adaptation."""

import msgspec

from dualbrain.contracts.contract import Contract
from dualbrain.contracts.verdict import Accepted
from dualbrain.core.geometry.shapes import Box, Pose
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.hashing_encoder import HashingEncoder
from dualbrain.memory.embedding.joint_embedding import EmbeddingConfig
from dualbrain.memory.embedding.posture_features import Posture, PostureLimits
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader
from dualbrain.memory.memory import Memory
from dualbrain.memory.plasticity.hebbian_update import Plasticity
from dualbrain.records import Attempt, Episode, Outcome, Place, Proposal, RetrievedContext, Scene, SceneObject

REGISTRY = load_skill_registry("panda")
NOW = 1_800_000_000.0
LIMITS = tuple(PostureLimits(name, (-3.0,), (3.0,), 0.08) for name in ("panda", "ur5e"))
CONFIG = MemoryConfig(limits=LIMITS, embedding=EmbeddingConfig(features=16), plasticity=Plasticity(kappa=0.0))
GRASP_PARAMETERS = {
    "object": "red_cube",
    "speed": 0.2,
    "clearance": 0.15,
    "finger_axis": "along",
    "opening": 0.08,
    "approach": "top",
    "wait": "none",
    "force": 15.0,
}
PLACE_PARAMETERS = {"destination": "blue_bowl", "speed": 0.2, "clearance": 0.15, "route": "direct", "wait": "none"}


def pick_contract(*, id="c-0001", registry=REGISTRY.hash, robot="panda", **changed):
    """A contract that grasps and places; `changed` parameters of the grasp."""
    steps = [{"skill": "grasp", "params": GRASP_PARAMETERS | changed}, {"skill": "place", "params": PLACE_PARAMETERS}]
    return {"id": id, "context": {"robot": robot, "registry": registry}, "action_sequence": steps}


def scene(*, x=0.5, y=0.0, robot="panda", other=""):
    """A cube at (x, y) and a bowl."""
    cube = SceneObject(name="red_cube", role="object", shape=Box((0.02, 0.02, 0.02)), pose=Pose((x, y, 0.02)))
    bowl = SceneObject(name="blue_bowl", role="container", shape=Box((0.1, 0.1, 0.05)), pose=Pose((0.4, 0.3, 0.0)))
    more = (
        (SceneObject(name=other, role="object", shape=Box((0.02, 0.02, 0.02)), pose=Pose((0.6, 0.2, 0.02))),)
        if other
        else ()
    )
    return Scene(
        robot=robot, stamp=0.0, version=1, objects=(cube, bowl, *more), places=(Place("table_left", (0.5, 0.3, 0.0)),)
    )


def summary(symbols="path_max_height none", number=0):
    things = f"red_cube: object, {symbols}\nblue_bowl: container"
    return f"robot panda; holding nothing\n{things}\nperson: none\nplaces: p{number}"


def episode(
    name,
    kind="succeeded",
    *,
    Delta=0.001,
    duration=10.0,
    instruction="put the red cube in the bowl",
    scene_summary=None,
    perceived_scene=None,
    plan=None,
    proposer="smollm2-135m-instruct",
    versions=None,
    second_opinion="agrees",
    robot="panda",
    registry=REGISTRY.hash,
):
    contract = plan or pick_contract(robot=robot, registry=registry)
    proposal = Proposal(
        text="{}", finish_reason="stop", planner=proposer, constrained_by="nothing", timings={"total": 0.1}
    )
    verdict = Accepted(msgspec.convert(contract, Contract))
    return Episode(
        id=name,
        started="2027-01-15T08:00:00Z",
        instruction=instruction,
        robot=robot,
        registry=registry,
        seed=1,
        scene=perceived_scene or scene(),
        summary=scene_summary or summary(),
        recall=RetrievedContext(),
        attempts=(Attempt(proposal, verdict, 1e-4),),
        contract=contract,
        outcome=Outcome(kind=kind, reason="", Delta=Delta, duration=duration),
        judgement=None,
        timings={"plan": 1.0},
        versions={"dualbrain": "0", "filter": "on"} if versions is None else versions,
        second_opinion=second_opinion,
    )


def write_ledger(folder, episodes, then=lambda memory: None):
    """A ledger of `episodes` in `folder`, opened for reading after `then` has changed the memory."""
    path = folder / "ledger.sqlite"
    with Ledger(path, holder="a test", now=NOW) as ledger:
        memory = Memory(ledger, HashingEncoder(32), CONFIG)
        for one in episodes:
            memory.store(one, Posture((0.0,), 0.04), now=NOW)
        then(memory)
    return LedgerReader(path)


def distinct_episodes(n, **same):
    """`n` clean episodes in scenes of their own."""
    return [
        episode(
            f"e{i}",
            perceived_scene=scene(x=0.3 + 0.1 * (i % 4), y=-0.4 + 0.1 * (i // 4)),
            scene_summary=summary(number=i),
            **same,
        )
        for i in range(n)
    ]
