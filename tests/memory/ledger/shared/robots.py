"""Robots that share a ledger in the tests: the file of each, its ledger and its memory."""

from dataclasses import dataclass
from pathlib import Path

from dualbrain.memory.ledger.ledger import Ledger
from dualbrain.memory.ledger.postgres.store import PostgresStore
from dualbrain.memory.ledger.shared.config import SharedLedgerConfig, format_shared_config
from tests.memory.memory_samples import NOW


@dataclass(frozen=True)
class Lab:
    """A shared ledger at `url`, with a folder for the files of its robots and a connection of its own."""

    url: str
    namespace: str
    folder: Path
    store: PostgresStore

    def path(self, name: str, *, url: str = "", use_memories_of: tuple[str, ...] = (), index: str = "scan") -> Path:
        """The file of the robot `name`."""
        config = SharedLedgerConfig(
            url=url or self.url, name=name, namespace=self.namespace, use_memories_of=use_memories_of, index=index
        )
        (self.folder / name).mkdir(exist_ok=True)
        path = self.folder / name / "lab.toml"
        path.write_text(format_shared_config(config), "utf-8")
        return path

    def open(self, name: str, *, url: str = "", use_memories_of: tuple[str, ...] = (), index: str = "scan") -> Ledger:
        """The ledger of the robot `name`, opened for writing."""
        return Ledger(self.path(name, url=url, use_memories_of=use_memories_of, index=index), holder="a test", now=NOW)
