"""Recipients that an instruction calls by their name: "take the cube over to Anna"."""

from __future__ import annotations

import re
from collections.abc import Iterator

from dualbrain.grounding.instruction.clauses.scene_words import SceneWords, first_matches
from dualbrain.grounding.instruction.words import Words

_TO_NAME = re.compile(
    r"\b(?:give|bring|take|carry|pass|hand|deliver|show|offer|return|get"
    r"|send)\b[^.;!?]{0,60}? to (?P<name>[a-z]{2,20})\b"
)
_NO_NAMES = frozenset({"the", "a", "an", "my", "your", "our", "its", "this", "that", "it", "home", "left", "right"})


def recipients_by_name(words: Words, scene: SceneWords) -> Iterator[tuple[int, int]]:
    """Start and end of each request to take something to a word with a capital letter that is no name of the scene."""
    for match in first_matches(_TO_NAME, words.text):
        name = words.quote(match.start("name"), match.end("name"))
        written_as_name = name[:1].isupper() and name[1:].islower() and match["name"] not in _NO_NAMES
        if written_as_name and not scene.mentions(match["name"], scene.names):
            yield match.start(), match.end()
