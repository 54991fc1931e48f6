"""Opens a planner by a name, a GGUF file or an address."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import urldefrag

from dualbrain.core.weights import MANIFEST, locate_weights
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.planner.backends.key_redaction import HIDDEN
from dualbrain.planner.backends.llama_cpp import LlamaConfig, LlamaPlanner
from dualbrain.planner.backends.openai_server import ServerConfig, ServerPlanner
from dualbrain.planner.protocol import Planner

DEFAULT_PLANNER = "qwen2.5-coder-1.5b-instruct"
PACKAGED_PLANNER = "base-135m"
"""The planner of `dualbrain demo` and `dualbrain.run`: an adapter in the package, on a base model of 98 MB.

The experiment `starter` chooses it among all packaged planners by one rule.
"""
SMALL_PLANNER = "smollm2-135m-instruct"
"""A small model for tests; without an adapter it does not plan usefully."""
GGUF_MAGIC = b"GGUF"
"""First bytes of a GGUF file."""

UNKNOWN_NAME_KIND = "planner"
OTHER_FORMS_HINT = "a GGUF file or URL also works"
"""Parts of the error for an unknown name, here and in callers that know more names."""


LANGUAGES_MARK = "&languages="
"""In the fragment of an address: the languages that the model reads, such as `#model-name&languages=en,de`."""
PROMPT_MARK = "&prompt="
"""Before the name of the prompt that a server's model was trained on."""


def planner_names() -> tuple[str, ...]:
    """Names of the language models in the manifest."""
    return tuple(name for name, file in MANIFEST.items() if file.filename.endswith(".gguf"))


def open_planner(
    name_or_url: str,
    cache: Path,
    *,
    key: str = "",
    dialect: str = "openai",
    threads: int = 1,
    timeout_s: float = 600.0,
    prompt_cache: Path | None = None,
) -> Planner:
    """The planner with the name or address `name_or_url`, ready to propose.

    `name_or_url` is a name in the manifest (its verified file is in `cache`), the path of a GGUF file, or an address
    such as `http://localhost:8000/v1#model-name` (with languages: `#model-name&languages=en,de`; for an adapted model:
    `#model-name&prompt=short`, last), which is used with `dialect` and `key`; `vllm+http://...` names the dialect
    itself. `prompt_cache` is described in `LlamaConfig`; `timeout_s` [s] limits one proposal. Raises
    `UnknownNameError`, `MissingDependencyError`, `ChecksumError` and `ConfigurationError`.
    """
    if "://" in name_or_url:
        prefix, separator, rest = name_or_url.partition("+http")
        has_dialect = separator and "://" not in prefix
        dialect, address = (prefix, f"http{rest}") if has_dialect else (dialect, name_or_url)
        url, fragment = urldefrag(address)
        before, _, prompt = fragment.partition(PROMPT_MARK)
        model, _, languages = before.partition(LANGUAGES_MARK)
        return ServerPlanner(
            ServerConfig(
                url=url,
                model=model or "default",
                key=key,
                dialect=dialect,
                prompt=prompt or "full",
                timeout_s=timeout_s,
                languages=tuple(one.strip() for one in languages.split(",") if one.strip()),
            )
        )
    config = LlamaConfig(threads=threads, timeout_s=timeout_s, prompt_cache=prompt_cache)
    if name_or_url.endswith(".gguf"):
        _require_gguf(Path(name_or_url))
        return LlamaPlanner(Path(name_or_url).stem, Path(name_or_url), config)
    if name_or_url not in planner_names():
        shown = HIDDEN if "@" in name_or_url else name_or_url  # an address without its http:// may contain a password
        raise UnknownNameError(UNKNOWN_NAME_KIND, shown, planner_names(), owner=f"the manifest ({OTHER_FORMS_HINT})")
    return LlamaPlanner(name_or_url, locate_weights(name_or_url, cache), config)


def _require_gguf(path: Path) -> None:
    """Raise `ConfigurationError` if the file at `path` exists and does not begin as a GGUF file."""
    if not path.is_file():
        return
    with path.open("rb") as file:
        if file.read(len(GGUF_MAGIC)) != GGUF_MAGIC:
            raise ConfigurationError.stating(
                f"{path} is not a GGUF file, or it is damaged.", fix="Name a complete GGUF file, or get this one again."
            )
