"""Resolution of mesh names (package://, file:// and relative names) within the folders that a description may use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dualbrain.errors import ConfigurationError, MissingDependencyError

LAYOUT_FOLDERS = ("urdf", "robots", "robot", "xml", "mjcf", "xacro", "model", "models")
"""Usual names of the folder of a description, which is a sibling of `meshes/`."""
MAX_PARENT_FOLDERS = 6
"""Number of parent folders in which a package is searched for."""


@dataclass(frozen=True, slots=True)
class AllowedFolders:
    """Folders that one description may read: its own folder, its package, and the `packages` given by the user."""

    description_folder: Path
    package_folder: Path
    packages: tuple[Path, ...] = ()

    def find(self, name: str, where: str) -> Path:
        """The file called `name` in the description at `where` (file and line).

        Raises:
            ConfigurationError: `name` is a web address, or a path outside the allowed folders.
            MissingDependencyError: The file does not exist.
        """
        if name.startswith("package://"):
            return self._resolve_package_url(name, where)
        if "://" in name and not name.startswith("file://"):
            raise ConfigurationError(f"mesh of {where}", got=name, allowed="package://, file:// or a relative name")
        relative = Path(name.removeprefix("file://"))
        path = self.description_folder / relative
        return self._check_inside((self.package_folder, *self.packages), path, name, where)

    def _resolve_package_url(self, name: str, where: str) -> Path:
        package, _, rest = name.removeprefix("package://").partition("/")
        roots = self._package_roots(package)
        if not roots:
            if (path := self._find_without_package(rest)) is not None:
                return self._check_inside((self.package_folder,), path, name, where)
            raise MissingDependencyError(
                f"The package {package!r} of {where} ({name})",
                fix=f"Give the folder that contains {package!r}: --packages FOLDER.",
            )
        for root in roots:
            if (root / rest).is_file():
                return self._check_inside((root,), root / rest, name, where)
        return self._check_inside((roots[0],), roots[0] / rest, name, where)

    def _package_roots(self, package: str) -> list[Path]:
        """Folders called `package`: parents of the description, their children, and children of `packages`."""
        if package in ("", ".", ".."):
            return []
        parents = [self.description_folder, *list(self.description_folder.parents)[:MAX_PARENT_FOLDERS]]
        found = [folder for folder in parents if folder.name == package]
        found += [folder / package for folder in (*self.packages, *parents) if (folder / package).is_dir()]
        return found

    def _find_without_package(self, rest: str) -> Path | None:
        """The file in the description's own folder, for a robot folder that was copied out of a package of many robots.

        `rest` is the path inside the package; it must contain the name of the robot folder.
        """
        parts = rest.split("/")
        if self.package_folder.name not in parts:
            return None
        path = self.package_folder.joinpath(*parts[parts.index(self.package_folder.name) + 1 :])
        return path if path.is_file() else None

    @staticmethod
    def _check_inside(allowed: Sequence[Path], path: Path, name: str, where: str) -> Path:
        real = path.resolve()
        if not any(real.is_relative_to(folder.resolve()) for folder in allowed):
            raise ConfigurationError(
                f"mesh of {where}",
                got=name,
                allowed=f"a file inside {', '.join(str(folder) for folder in allowed)}",
                fix="To use this file, allow its folder: --packages FOLDER.",
            )
        if not real.is_file():
            raise MissingDependencyError(
                f"The mesh {name!r} of {where}", fix=f"It was expected at {real}. Other folders: --packages FOLDER."
            )
        return real


def allowed_folders(file: Path, packages: Sequence[Path] = ()) -> AllowedFolders:
    """The folders that the description `file` may use.

    The package folder is the nearest parent with a `package.xml`; without one it is the folder of the description, or
    the parent of a folder with a usual name (`LAYOUT_FOLDERS`).
    """
    description_folder = file.resolve().parent
    package_folder = description_folder.parent if description_folder.name in LAYOUT_FOLDERS else description_folder
    for folder in [description_folder, *list(description_folder.parents)[:MAX_PARENT_FOLDERS]]:
        if (folder / "package.xml").is_file():
            package_folder = folder
            break
    return AllowedFolders(description_folder, package_folder, tuple(folder.resolve() for folder in packages))
