"""Stop commands: instructions that consist of nothing but a stop word, such as "stop", "Halt!" or "don't move".

They act in the local layer, without a planner. An instruction that only contains such a word ("put the stop sign in the
bowl", "do not stop") is no stop command.
"""

from __future__ import annotations

import re
from itertools import groupby

from dualbrain.grounding.instruction.words import normalise

_REPEATED_LETTER = re.compile(r"(\w)\1{2,}")
_FILLERS = frozenset(
    [
        "please",
        "now",
        "robot",
        "hey",
        "ok",
        "okay",
        "immediately",
        "instantly",
        "just",
        "quickly",
        "quick",
        "already",
        "oh",
        "god",
        "no",
        "the",
        "arm",
        "everything",
        "all",
        "motion",
        "movement",
        "there",
        "here",
        "right",
        "away",
        "at",
        "once",
        "i",
        "said",
        "dear",
        "you",
        "hand",
        "gripper",
        "base",
        "machine",
        "robo",
        "amigo",
        "buddy",
        "mate",
        "man",
        "dude",
        "pal",
        "this",
        "instant",
        "careful",
        "bitte",
        "sofort",
        "jetzt",
        "por",
        "favor",
        "per",
        "favore",
        "s'il",
        "te",
        "vous",
        "plaît",
        "plait",
        "ya",
        "adesso",
        "subito",
        "nu",
        "tout",
        "de",
        "suite",
        "maintenant",
        "ahora",
    ]
)
"""Words around a stop word that change nothing."""
_OPENINGS = frozenset(
    (
        *("can", "could", "would", "will", "must", "should", "shall", "have", "need", "want", "has", "to", "we", "it"),
        *("make", "let", "us", "go", "my", "damn", "dammit", "fucking", "bloody", "ow", "ouch", "ah", "argh", "for"),
        *(
            "god's",
            "heaven's",
            "sake",
            "robbie",
            "is",
            "that",
            "think",
            "better",
            "had",
            "so",
            "ok",
            "and",
            "yes",
            "well",
        ),
        *("thanks", "thank", "wait", "told", "really", "am", "be", "quickly", "asking", "sorry", "excuse", "me"),
    )
)
"""Words in front of a stop word that do not turn its meaning, besides `_FILLERS`."""
_STOP_WORDS = frozenset(
    ("stop", "stopp", "stopping", "stpo", "sotp", "stoop", "stahp", "halt", "freeze", "abort", "cease", "quit", "whoa")
)
_QUESTION = re.compile(r"^(?:why (?:do|can|could|will|would)|can|could|will|would) (?:not you|you not) ")
"""A negation that asks for the stop: "can't you stop"."""
_DEPENDENCES = frozenset(
    (
        *("at", "if", "when", "whenever", "once", "until", "after", "before", "in", "near", "by", "behind", "on"),
        *(
            "next",
            "beside",
            "above",
            "over",
            "between",
            "as",
            "unless",
            "sign",
            "button",
            "waiting",
            "pausing",
            "pause",
        ),
    )
)
"""Words that follow a stop word if the stop depends on a place, a time or a condition, or if the word is none."""
_ALARMS = frozenset(
    (
        *("ouch", "ow", "help", "help me", "it hurts", "that hurts", "this hurts", "it is hurting me", "let me go"),
        *("are hurting me", "back off", "get off me", "get off", "do not touch me", "no more", "do not go on"),
        *("do not continue", "do not go further", "danger", "person", "mayday", "panic", "kill it", "no", "no way"),
        *("that is it", "do not proceed", "cut the power", "kill the power", "get away from me", "stay away from me"),
        *("kill switch", "desist", "time out", "timeout", "slow down", "slower", "not so fast", "too fast", "careful"),
        *("hold up", "that will do", "not any more", "turn off", "ah", "aah", "argh"),
    )
)
"""Words without a stop word that a moving robot takes as one."""
_SIGNS = ("\N{OCTAGONAL SIGN}", "\N{NO ENTRY}", "\N{RAISED HAND}")
_ENGLISH = (
    "stop",
    "stpo",
    "sotp",
    "stopp",
    "stop it",
    "stop that",
    "stop this",
    "stop moving",
    "stop working",
    "stop going",
    "stop driving",
    "stop doing that",
    "stop doing this",
    "stop what you are doing",
    "stop where you are",
    "stop dead",
    "stop now",
    "full stop",
    "halt",
    "halt it",
    "freeze",
    "hold",
    "hold on",
    "hold it",
    "hold still",
    "hold your position",
    "hold position",
    "hold your horses",
    "hang on",
    "wait",
    "wait stop",
    "wait a moment",
    "wait a second",
    "wait a minute",
    "pause",
    "whoa",
    "woah",
    "whoah",
    "wo",
    "abort",
    "abort it",
    "abort that",
    "abort mission",
    "abort the mission",
    "abort the task",
    "cancel",
    "cancel it",
    "cancel that",
    "cancel the task",
    "cease",
    "cease moving",
    "quit",
    "quit it",
    "quit that",
    "quit moving",
    "call it off",
    "break it off",
    "never mind",
    "nevermind",
    "forget it",
    "hands off",
    "shut down",
    "shut it down",
    "shut it off",
    "switch off",
    "switch it off",
    "turn it off",
    "power off",
    "power down",
    "cut the power",
    "watch out",
    "look out",
    "terminate",
    "interrupt",
    "enough",
    "that is enough",
    "do not move",
    "do not move any further",
    "do not move any more",
    "do not move a muscle",
    "do not move an inch",
    "do not drive",
    "do not drive any further",
    "do not go any further",
    "do not do that",
    "do not do it",
    "do not do anything",
    "do not",
    "no further",
    "not another step",
    "stand still",
    "stay still",
    "keep still",
    "be still",
    "sit still",
    "stay",
    "stay put",
    "stay where you are",
    "stand down",
    "come to rest",
    "come to a stop",
    "come to a halt",
    "brake",
    "hit the brakes",
    "knock it off",
    "cut it out",
    "emergency stop",
    "emergency",
    "e stop",
    "estop",
)
_OTHER_LANGUAGES = (
    *("stopp", "halt", "anhalten", "halt an", "bleib stehen", "stehenbleiben", "hör auf", "aufhören", "nicht bewegen"),
    *("keine bewegung", "warte", "not halt", "nothalt", "notaus", "abbrechen", "abbruch", "stillhalten"),  # German
    *("arrête", "arrete", "arrêtez", "arretez", "arrête toi", "arrêtez vous", "arrêt", "halte", "ne bouge pas"),
    *("ne bouge plus", "ne bougez pas", "ne bougez plus", "stoppe", "attends", "arrêt d'urgence"),  # French
    *("para", "pare", "parar", "párate", "parate", "alto", "detente", "detén", "deténte", "deténgase", "detengase"),
    *("quieto", "no te muevas", "no se mueva", "espera", "basta"),  # Spanish
    *("pára", "parem", "não se mexa", "nao se mexa", "não te mexas", "espere"),  # Portuguese
    *("ferma", "fermati", "fermo", "si fermi", "non muoverti", "non ti muovere", "aspetta", "alt"),  # Italian
    *("hou op", "ophouden", "niet bewegen", "sta stil", "stoppen", "wacht"),  # Dutch
    *("stanna", "stoppa", "rör dig inte", "stans", "stå stille", "rør dig ikke", "ikke rør deg", "vent", "stands"),
    *("pysähdy", "seis", "älä liiku", "seisku"),  # Swedish, Danish, Norwegian, Finnish
    *("stój", "stop", "zatrzymaj się", "nie ruszaj się", "przestań"),  # Polish
    *("stůj", "zastav", "zastav se", "nehýbej se", "stoj", "stani", "zaustavi se", "állj", "állj meg", "ne mozogj"),
    *("oprește", "oprește te", "opreste", "stai", "dur", "durun", "kıpırdama", "hareket etme", "berhenti", "dừng lại"),
    *("стоп", "стой", "остановись", "остановитесь", "не двигайся", "замри", "стій", "зупинись", "спри", "стани"),
    *("σταμάτα", "στοπ", "σταμάτησε", "μην κινείσαι", "ακίνητος"),
    *("停", "停止", "停下", "停下来", "住手", "别动", "不要动", "不许动", "暂停", "停車", "停下來", "別動", "不要動"),
    *(
        "止まれ",
        "とまれ",
        "止まって",
        "とまって",
        "止めて",
        "やめて",
        "やめろ",
        "ストップ",
        "動くな",
        "待て",
        "待って",
        "停止して",
    ),
    *("멈춰", "멈추세요", "멈춰요", "정지", "그만", "스톱", "움직이지 마", "서"),
    *("قف", "توقف", "لا تتحرك", "ایست", "بس کن", "עצור", "עצרי", "תעצור", "לא לזוז"),
    *("रुको", "रुकिए", "रुक जाओ", "रोको", "ठहरो", "หยุด", "หยุดนะ"),
)


def is_stop_command(instruction: str) -> bool:
    """Whether `instruction` consists of stop commands and words such as "please", in one of the known languages."""
    words = normalise(instruction).text.split()
    return _core(words) in _STOP_COMMANDS or _is_sequence(words) or _is_sign(instruction)


def asks_to_stop(words: str) -> bool:
    """Whether words that a person says while the robot moves ask it to stop: "can you stop please", "stop, it hurts".

    Wider than `is_stop_command`, because other words have no effect during a motion. A stop that depends on a place, a
    time or a condition ("stop at the shelf") and a negated one ("do not stop") are none.
    """
    heard = normalise(words).text.split()
    parts = [list(part) for is_part, part in groupby(heard, _is_heard) if is_part]
    return is_stop_command(words) or any(_is_alarm(part) or _orders_stop(part) for part in parts)


def _is_alarm(words: list[str]) -> bool:
    distinct = [word for word, _ in groupby(_REPEATED_LETTER.sub(r"\1", word) for word in words)]
    return " ".join(distinct) in _ALARMS or _core(words) in _ALARMS


def _orders_stop(words: list[str]) -> bool:
    """Whether the first words apart from `_OPENINGS` and `_FILLERS` are a stop word, and an unconditional one."""
    heard = _QUESTION.sub("", " ".join(_REPEATED_LETTER.sub(r"\1", word) for word in words)).split()
    number = next((index for index, word in enumerate(heard) if word not in _OPENINGS | _FILLERS), len(heard))
    if number == len(heard) or heard[number] not in _STOP_WORDS:
        return False
    after = next((word for word in heard[number + 1 :] if word not in _FILLERS - {"at"}), "")
    return after not in _DEPENDENCES


def _is_sequence(words: list[str]) -> bool:
    """Whether `words` are stop commands between punctuation marks, such as "wait, stop!"."""
    parts = [_core(list(part)) for is_heard, part in groupby(words, _is_heard) if is_heard]
    stated = [part for part in parts if part]
    return bool(stated) and _STOP_COMMANDS.issuperset(stated)


def _is_sign(instruction: str) -> bool:
    return any(sign in instruction for sign in _SIGNS) and not any(map(str.isalnum, instruction))


def _is_heard(word: str) -> bool:
    return any(map(str.isalnum, word))


def _core(words: list[str]) -> str:
    """The words without fillers, repetitions and punctuation marks."""
    heard = [_REPEATED_LETTER.sub(r"\1", word) for word in words if _is_heard(word)]
    kept = " ".join(heard)
    if kept in _STOP_COMMANDS_BEFORE_FILLERS:
        return kept
    core = [word for word in heard if word not in _FILLERS]
    distinct = [word for index, word in enumerate(core) if index == 0 or word != core[index - 1]]
    half = len(distinct) // 2
    if half > 1 and len(distinct) % 2 == 0 and distinct[:half] == distinct[half:]:
        distinct = distinct[:half]
    return " ".join(distinct)


def _normal(command: str) -> str:
    return " ".join(filter(_is_heard, normalise(command).text.split()))


_STOP_COMMANDS_BEFORE_FILLERS = frozenset(_normal(command) for command in (*_ENGLISH, *_OTHER_LANGUAGES))
_STOP_COMMANDS = _STOP_COMMANDS_BEFORE_FILLERS | frozenset(
    " ".join(word for word in command.split() if word not in _FILLERS) for command in _STOP_COMMANDS_BEFORE_FILLERS
) - {""}
