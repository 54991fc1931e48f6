"""Where a description's meshes lie: package://, file:// and relative names, never outside the folders it may use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dualbrain.errors import ConfigurationError, MissingDependencyError

LAYOUT_FOLDERS = ("urdf", "robots", "robot", "xml", "mjcf", "xacro", "model", "models")
"""Folders in which a description lies beside `meshes/`, by custom."""
MAX_PARENT_FOLDERS = 6
"""How many folders up a package is looked for."""


@dataclass(frozen=True, slots=True)
class AllowedFolders:
    """What one description may read: its own folder (its package), and `packages` given by the user."""

    description_folder: Path
    package_folder: Path
    packages: tuple[Path, ...] = ()

    def find(self, name: str, where: str) -> Path:
        """The file that `name` means, as it is written at `where`.

        Raises:
            InvalidSetup: `name` is a web address, or leads out of the allowed folders.
            MissingPart: there is no such file.
        """
        if name.startswith("package://"):
            return self._resolve_package_url(name, where)
        if "://" in name and not name.startswith("file://"):
            raise ConfigurationError(f"mesh of {where}", got=name, allowed="package://, file:// or a relative name")
        plain = Path(name.removeprefix("file://"))
        return self._check_inside((self.package_folder, *self.packages), self.description_folder / plain, name, where)

    def _resolve_package_url(self, name: str, where: str) -> Path:
        package, _, rest = name.removeprefix("package://").partition("/")
        roots = self._package_roots(package)
        if not roots:
            if (alone := self._find_without_package(rest)) is not None:
                return self._check_inside((self.package_folder,), alone, name, where)
            raise MissingDependencyError(
                f"The package {package!r} of {where} ({name})",
                fix=f"Say where it lies: --packages FOLDER, the folder that holds {package!r}.",
            )
        for root in roots:
            if (root / rest).is_file():
                return self._check_inside((root,), root / rest, name, where)
        return self._check_inside((roots[0],), roots[0] / rest, name, where)

    def _package_roots(self, package: str) -> list[Path]:
        """Folders called `package`: among the description's ancestors, beside them, or in a folder that was given."""
        if package in ("", ".", ".."):
            return []
        above = [self.description_folder, *list(self.description_folder.parents)[:MAX_PARENT_FOLDERS]]
        found = [folder for folder in above if folder.name == package]
        found += [folder / package for folder in (*self.packages, *above) if (folder / package).is_dir()]
        return found

    def _find_without_package(self, rest: str) -> Path | None:
        """The file in the description's own folder, if that is all that was copied out of a package of many robots.

        `rest` is the name inside the package; the own folder's name stands in it.
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
                fix="If it is meant, allow its folder: --packages FOLDER.",
            )
        if not real.is_file():
            raise MissingDependencyError(
                f"The mesh {name!r} of {where}", fix=f"Looked for {real}. Other folders: --packages FOLDER."
            )
        return real


def allowed_folders(file: Path, packages: Sequence[Path] = ()) -> AllowedFolders:
    """The folders that the description `file` may use: its own, one up by the usual layout, and those given."""
    home = file.resolve().parent
    own = home.parent if home.name in LAYOUT_FOLDERS else home
    for folder in [home, *list(home.parents)[:MAX_PARENT_FOLDERS]]:
        if (folder / "package.xml").is_file():
            own = folder
            break
    return AllowedFolders(home, own, tuple(folder.resolve() for folder in packages))
