"""Resources of one run, opened from its configuration before any motion: robot, scene, planner, memory, world."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass

from dualbrain.adaptation.serving.open_planner import open_planner
from dualbrain.contracts.gate.strict_json import MAX_CONTRACT_FILE_BYTES
from dualbrain.contracts.registry import is_narrower
from dualbrain.core import weights
from dualbrain.core.storage.private_files import open_private_folder
from dualbrain.core.untrusted.bounded_file import read_bounded_file
from dualbrain.grounding.document_retrieval import Budget, consulted_budget, retrieve_passages
from dualbrain.grounding.envelope.robot_at_site import RobotAtSite, open_robot_at_site
from dualbrain.grounding.instruction.clauses.clause_classifier import ClauseClassifier
from dualbrain.grounding.instruction.stop_commands import is_stop_command
from dualbrain.grounding.map_overlay import apply_map
from dualbrain.grounding.outcome.instruction_truth import make_instruction_judge
from dualbrain.knowledge.builtin_documents import open_library
from dualbrain.knowledge.library import Library
from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.image_encoder import IMAGE_WEIGHTS, ImageEncoder
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.posture_features import PostureLimits
from dualbrain.memory.embedding.text_encoder import MiniLmEncoder
from dualbrain.memory.ledger.ledger import Ledger
from dualbrain.memory.memory import Memory
from dualbrain.memory.plasticity.hebbian_update import Plasticity
from dualbrain.planner.camera_image import CameraImage
from dualbrain.planner.introspection import no_documents_reason, require_image_input
from dualbrain.planner.protocol import Planner
from dualbrain.planner.scripted import FixedContractPlanner
from dualbrain.records import Passage
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.runtime.config import Clocks, RunConfig
from dualbrain.runtime.planning.camera import capture_camera_image
from dualbrain.runtime.run_folder import END_STATE_FILE, RunFolder, refuse_used_folder
from dualbrain.simulation.perception.rendering import Camera
from dualbrain.simulation.plant.end_state import EndState, load_end_state
from dualbrain.simulation.scenes.generators.catalogue import open_scene, require_robot
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.multi_goal import parse_goals
from dualbrain.simulation.world import SimulatedWorld, make_world
from dualbrain.skills.registry import skill_registry


@dataclass(frozen=True, slots=True, kw_only=True)
class RunResources:
    """Open resources of a run.

    `start` is the end of the run that this one continues. `library` is None if no passages, `image_encoder` if no image
    features are requested. `budget`: limits on the passages. `sends_image`: the planner gets the camera image.
    """

    site: RobotAtSite
    spec: SceneSpec
    start: EndState | None
    library: Library | None
    budget: Budget
    image_encoder: ImageEncoder | None
    planner: Planner
    folder: RunFolder
    ledger: Ledger
    memory: Memory
    world: SimulatedWorld
    clause_classifier: ClauseClassifier | None
    sends_image: bool = False

    def retrieve_passages(self, instruction: str, summary: str) -> tuple[Passage, ...]:
        """Passages of the documents that bear on the instruction; none without documents."""
        if self.library is None:
            return ()
        registry = skill_registry(self.site.robot_model)
        return retrieve_passages(self.library, instruction, summary, registry, self.budget)

    def camera_image(self) -> CameraImage | None:
        """The front camera's current image for the planner, if it gets one; the image is saved in the run folder."""
        if not self.sends_image:
            return None
        image = capture_camera_image(self.world.plant)
        with self.folder.lent_space():
            self.folder.save_image(image)
        return image

    def image_features(self) -> ImageFeatures | None:
        """Features of the front camera's current image, if memory compares images."""
        if self.image_encoder is None:
            return None
        with Camera(self.world.plant, width=320, height=240) as camera:
            return self.image_encoder.encode(camera.capture())


def open_resources(
    config: RunConfig, clocks: Clocks, environ: Mapping[str, str], planner: Planner | None, stack: ExitStack
) -> RunResources:
    """Open all resources of a run; `stack` closes them. A `planner` that is passed in stays open.

    Raises `MissingDependencyError`, `ConfigurationError` and `UnknownNameError`.
    """
    refuse_used_folder(config.out)
    site = open_site(config)
    spec, start = open_beginning(config)
    encoder = MiniLmEncoder.from_cache(config.cache)
    if planner is None:
        planner = open_configured_planner(config, site.robot_model, environ)
        stack.callback(planner.close)
    consults = _reads_documents(config, planner)
    library = _open_library(config, clocks, encoder, stack) if consults or config.map else None
    if library is not None and config.map:
        spec = apply_map(spec, site.robot_model, library, config.map)
    goal = parse_goals(config.goal, spec) if config.goal else None
    image_encoder = _open_image_encoder(config)
    sends_image = config.image and not is_stop_command(config.instruction)
    if sends_image:
        require_image_input(planner)
    folder = RunFolder(config)
    stack.callback(folder.release)
    ledger = _open_ledger(config, clocks)
    stack.callback(ledger.close)
    world = make_world(
        spec,
        site.robot_model,
        seed=config.seed,
        goal=goal,
        visuals=config.visuals,
        pace=clocks.pace,
        instruction_judge=make_instruction_judge(config.instruction),
        start=start.robot if start else None,
    )
    return RunResources(
        site=site,
        spec=spec,
        start=start,
        library=library if consults else None,
        budget=consulted_budget(config.consult),
        image_encoder=image_encoder,
        planner=planner,
        folder=folder,
        ledger=ledger,
        memory=_make_memory(config, site, ledger, encoder),
        world=world,
        clause_classifier=ClauseClassifier.packaged(encoder),
        sends_image=sends_image,
    )


def open_beginning(config: RunConfig) -> tuple[SceneSpec, EndState | None]:
    """The scene of a run, and the end of the run that it continues; None for a run that begins with its scene."""
    if config.after is None:
        return open_scene(config.scene, config.robot), None
    start = load_end_state(config.after / END_STATE_FILE)
    return require_robot(config.robot, start.scene), start


def open_site(config: RunConfig) -> RobotAtSite:
    """The robot of a run at its site."""
    return open_robot_at_site(config.robot, config.site)


def _reads_documents(config: RunConfig, planner: Planner) -> bool:
    """Whether passages of documents are put into the prompt of `planner`."""
    return config.consult != "off" and config.contract is None and not no_documents_reason(planner)


def _open_library(config: RunConfig, clocks: Clocks, encoder: MiniLmEncoder, stack: ExitStack) -> Library | None:
    """The documents, if there is a store for them; a store for packaged documents is made only if they are read."""
    if config.knowledge is None or not (config.knowledge.exists() or config.consult == "on" or config.map):
        return None
    library = open_library(config.knowledge, encoder, now=clocks.now())
    stack.callback(library.close)
    return library


def _open_image_encoder(config: RunConfig) -> ImageEncoder | None:
    return ImageEncoder(weights.locate_weights(IMAGE_WEIGHTS, config.cache)) if config.image_memory else None


def open_configured_planner(config: RunConfig, robot_model: RobotModel, environ: Mapping[str, str]) -> Planner:
    """The planner of the configuration; a given contract and a stop command need none."""
    if config.contract:
        return FixedContractPlanner(
            f"file {config.contract.name}", read_bounded_file(config.contract, MAX_CONTRACT_FILE_BYTES)
        )
    if is_stop_command(config.instruction):
        return FixedContractPlanner("no planner: a stop command", b"")
    prefixes = config.cache / "prefixes"
    open_private_folder(prefixes)
    registry, own = skill_registry(robot_model), skill_registry(load_robot(config.robot))
    return open_planner(
        config.planner,
        config.cache,
        adapters=config.adapters or config.ledger.with_name("adapters"),
        robot=robot_model.name,
        registry=registry.hash,
        key=environ.get("OPENAI_API_KEY", ""),
        threads=config.planner_threads,
        prompt_cache=prefixes,
        narrowed_registries={registry.hash: own.hash} if is_narrower(registry, own) else {},
    )


def _open_ledger(config: RunConfig, clocks: Clocks) -> Ledger:
    holder = f"dualbrain run {config.out.name}"
    return Ledger(config.ledger, holder=holder, now=clocks.now(), run_folders=(config.out.parent,))


def _make_memory(config: RunConfig, site: RobotAtSite, ledger: Ledger, encoder: MiniLmEncoder) -> Memory:
    rule = None if config.static else Plasticity(epsilon=config.epsilon)
    limits = (PostureLimits.from_model(site.model_without_site),)
    return Memory(ledger, encoder, MemoryConfig(limits=limits, plasticity=rule))
