"""The folder of one run: its files, and the disk space that is reserved for its end and for the memory ledger."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import msgspec

from dualbrain.control.recording.recording_file import RECORDING_RESERVE
from dualbrain.core.storage.atomic_files import translated_write_errors, write_atomically
from dualbrain.core.storage.private_files import create_private_folder, open_private_folder
from dualbrain.core.storage.reserved_space import ReservedSpace
from dualbrain.errors import ConfigurationError
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.ledger.anchors import RUN_ANCHOR_FILE
from dualbrain.memory.memory import StoreReport
from dualbrain.planner.camera_image import CameraImage
from dualbrain.records import Episode
from dualbrain.runtime.agent import EpisodicMemory
from dualbrain.runtime.config import RunConfig
from dualbrain.simulation.scenes.scene_spec import SceneSpec, save_scene

RESERVED_BYTES = 8_000_000
"""Space [bytes] that is reserved in the run folder, beside that for the recording, and beside the memory ledger."""
END_STATE_FILE = "end.json"
"""File of the run folder with the state at the end, from which another run can continue (`RunConfig.after`)."""
RUN_FILES = (
    "config.json",
    "scene.json",
    "episode.mcap",
    "episode.json",
    "report.html",
    END_STATE_FILE,
    RUN_ANCHOR_FILE,
)
"""Files of a run folder."""


def refuse_used_folder(out: Path) -> None:
    """Raise `ConfigurationError` if the folder `out` already holds a run, so that no recording is overwritten."""
    found = sorted(name for name in RUN_FILES if (out / name).exists())
    if found:
        names = ", ".join(found)
        raise ConfigurationError.stating(
            f"The run folder {out} already holds a run ({names}).", fix="Name another --out."
        )
    if out.exists() and not out.is_dir():
        raise ConfigurationError.stating(f"The run folder {out} is a file.", fix="Name another --out.")


class RunFolder:
    """The open folder of a run, with reserved space there and beside the memory ledger."""

    def __init__(self, config: RunConfig) -> None:
        """Make the folders and reserve the space; raises `ConfigurationError` if there is too little.

        A run that may move unrecorded needs no reserved space.
        """
        self.path = config.out
        self._saved_ids: list[str] = []
        self._n_images = 0
        self._reserves: list[ReservedSpace] = []
        self._recording_reserve: ReservedSpace | None = None
        ledger = config.ledger.parent
        for folder, create in ((self.path, _create), (ledger, create_private_folder)):
            with translated_write_errors(folder):
                create(folder)
        try:
            self._reserve(ledger)
        except ConfigurationError:
            if not config.unrecorded:
                self.release()
                with suppress(OSError):  # not empty: it is not the folder that was made above
                    self.path.rmdir()
                raise

    def _reserve(self, ledger: Path) -> None:
        self._reserves.append(ReservedSpace(self.path, RESERVED_BYTES, "the files at the end of the run"))
        self._reserves.append(ReservedSpace(ledger, RESERVED_BYTES, "the memory ledger"))
        self._recording_reserve = ReservedSpace(self.path, RECORDING_RESERVE, "the end of the recording")
        self._reserves.append(self._recording_reserve)

    @contextmanager
    def lent_space(self) -> Generator[None]:
        """Free the reserved space for the writes of the body."""
        with ExitStack() as stack:
            for reserve in self._reserves:
                stack.enter_context(reserve.lent())
            yield

    def release_recording_space(self) -> None:
        """Free the space for the recording, which the recorder then reserves by itself."""
        if self._recording_reserve is not None:
            self._recording_reserve.release()

    def release(self) -> None:
        """Free all reserved space. May be called repeatedly."""
        for reserve in self._reserves:
            reserve.release()

    def save_start(self, config: RunConfig, spec: SceneSpec) -> None:
        """Save configuration and scene, before the run begins."""
        write_atomically(self.path / "config.json", config.encode())
        save_scene(spec, self.path / "scene.json")

    def save_image(self, image: CameraImage) -> None:
        """Save an image that the planner gets as `planner_image-N`; N counts the images of the run."""
        self._n_images += 1
        write_atomically(self.path / f"planner_image-{self._n_images}{image.suffix}", image.data)

    def save_episode(self, episode: Episode) -> None:
        """Save an episode as `episode.json`; the file of the try before is renamed to `episode-N.json`."""
        path = self.path / "episode.json"
        if episode.id not in self._saved_ids:
            if self._saved_ids:
                path.replace(self.path / f"episode-{len(self._saved_ids)}.json")
            self._saved_ids.append(episode.id)
        write_atomically(path, msgspec.json.format(msgspec.json.encode(episode), indent=2))


class SavingMemory:
    """A memory whose episodes are saved in the run folder before they are stored: an error of the ledger loses none."""

    def __init__(self, memory: EpisodicMemory, folder: RunFolder) -> None:
        """Store in `memory`, and save in `folder`, with the reserved space free for both."""
        self._memory, self._folder = memory, folder
        self.retrieve = memory.retrieve
        self.find_precedents, self.find_outcomes = memory.find_precedents, memory.find_outcomes

    def store(self, episode: Episode, state: Posture, *, now: float, image: ImageFeatures | None = None) -> StoreReport:
        """Save the episode, then store it; see `EpisodicMemory.store`."""
        with self._folder.lent_space():
            self._folder.save_episode(episode)
            return self._memory.store(episode, state, now=now, image=image)


def _create(out: Path) -> None:
    """Create the run folder with mode 0700; a folder with other files keeps its permissions."""
    if out.is_dir() and any(out.iterdir()):
        return
    open_private_folder(out)
