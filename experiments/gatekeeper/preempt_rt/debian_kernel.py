"""The newest PREEMPT_RT kernel in Debian's package lists: only its image is unpacked, nothing is installed."""

from __future__ import annotations

import re
import shutil
import subprocess
import tarfile
from pathlib import Path

from dualbrain.core.storage.file_lock import file_lock
from dualbrain.errors import MissingDependencyError

META_PACKAGES = ("linux-image-6.12-rt-amd64", "linux-image-rt-amd64")
"""Packages that depend on the newest kernel image; the first one with a kernel of at least 6.12 is used."""
IMAGE_PACKAGE = re.compile(r"^ *Depends: (linux-image-(\d+)\.(\d+)\S*-rt-amd64)$", re.MULTILINE)
OLDEST_KERNEL = (6, 12)
"""The first release with PREEMPT_RT in the main line of Linux."""


def fetch_kernel(folder: Path) -> Path:
    """The kernel image of the newest package, in `folder`; it is downloaded (about 110 MB) unless it is there.

    Raises:
        MissingDependencyError: this is no Debian, or the package cannot be found or downloaded.
    """
    folder.mkdir(parents=True, exist_ok=True)
    package = newest_package()
    image = folder / package.replace("linux-image", "vmlinuz")
    with file_lock(folder / "kernel.lock"):
        if not image.exists():
            _download(package, image)
    return image


def newest_package() -> str:
    """Name of the package with the newest kernel image.

    Raises:
        MissingDependencyError: the package lists have none.
    """
    if shutil.which("apt-cache") is None or shutil.which("dpkg-deb") is None:
        raise MissingDependencyError("Debian's package manager (apt, dpkg)", fix="Run the experiment on Debian.")
    for meta in META_PACKAGES:
        command = ["apt-cache", "depends", meta]
        listed = subprocess.run(command, capture_output=True, text=True, check=False).stdout
        if package := find_image_package(listed):
            return package
    names = " or ".join(META_PACKAGES)
    raise MissingDependencyError(f"A PREEMPT_RT kernel in the package lists ({names})", fix="Run: apt-get update")


def find_image_package(listed: str) -> str:
    """The image package in the output `listed` of `apt-cache depends`; empty if there is none, or one too old."""
    found = IMAGE_PACKAGE.search(listed)
    return found[1] if found and (int(found[2]), int(found[3])) >= OLDEST_KERNEL else ""


def _download(package: str, image: Path) -> None:
    """Download `package`, and copy the kernel out of it to `image`."""
    command = ["apt-get", "download", package]
    done = subprocess.run(command, cwd=image.parent, capture_output=True, text=True, check=False)
    archives = sorted(image.parent.glob(f"{package}_*.deb"))
    if done.returncode != 0 or not archives:
        fix = f"Run apt-get update, and check that {' '.join(command)} works. It reported:\n{done.stderr[-1000:]}"
        raise MissingDependencyError(f"The package {package}", fix=fix)
    unpacked = image.with_suffix(".part")
    unpacked.write_bytes(_read_image(archives[-1], package))
    unpacked.rename(image)
    for archive in archives:
        archive.unlink()


def _read_image(archive: Path, package: str) -> bytes:
    """The file boot/vmlinuz-* of a package; the archive is read only up to there."""
    command = ["dpkg-deb", "--fsys-tarfile", str(archive)]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as unpacking,
        tarfile.open(fileobj=unpacking.stdout, mode="r|") as members,
    ):
        for member in members:
            content = members.extractfile(member) if "boot/vmlinuz-" in member.name else None
            if content is not None:
                image = content.read()
                unpacking.kill()
                return image
    raise MissingDependencyError(f"The kernel image in the package {package}", fix="Report this; the package changed.")
