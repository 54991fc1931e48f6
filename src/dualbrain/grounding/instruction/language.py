"""The language of an instruction, as far as it is not English: by its script, or by its function words.

The detector decides only whether the text is English enough for planners that read English. It knows the scripts of
Unicode and the function words of some languages in Latin script; nonsense has no language.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Mapping
from dataclasses import dataclass

ENGLISH = "en"
ANY_LANGUAGE = "*"
"""In the languages of a planner: it reads all of them."""


@dataclass(frozen=True, slots=True)
class Language:
    """A language: its ISO 639-1 `code` ("" if only the script is known), and its English `name`."""

    code: str
    name: str


_SCRIPTS: Mapping[str, Language] = {
    "HIRAGANA": Language("ja", "Japanese"),
    "KATAKANA": Language("ja", "Japanese"),
    "HANGUL": Language("ko", "Korean"),
    "CJK": Language("zh", "Chinese"),
    "CYRILLIC": Language("ru", "Russian or another language in Cyrillic script"),
    "ARABIC": Language("ar", "Arabic or another language in Arabic script"),
    "HEBREW": Language("he", "Hebrew"),
    "GREEK": Language("el", "Greek"),
    "DEVANAGARI": Language("hi", "Hindi or another language in Devanagari script"),
    "BENGALI": Language("bn", "Bengali"),
    "TAMIL": Language("ta", "Tamil"),
    "TELUGU": Language("te", "Telugu"),
    "THAI": Language("th", "Thai"),
    "GEORGIAN": Language("ka", "Georgian"),
    "ARMENIAN": Language("hy", "Armenian"),
    "ETHIOPIC": Language("am", "Amharic or another language in Ethiopic script"),
}
"""Languages by the first word of the Unicode names of their letters; the first entry that occurs decides."""
_UKRAINIAN = frozenset("іїєґ")
_PERSIAN = frozenset("پچژگ")
_FUNCTION_WORDS: Mapping[Language, str] = {
    Language("de", "German"): (
        "der die das den dem des ein eine einen einem einer und oder nicht ist sind bitte auf aus bei mit"
        " nach von zu zum zur"
        " im ins wenn dann ich du er wir ihr sie es mir mich dir dich leg lege legen leg's nimm nehmen"
        " stell stelle stellen"
        " setz bring bringe bringen geh gehe gehen fahr fahre fahren nach schieb schiebe heb hebe greif"
        " greife roten rote rotes"
        " roter blaue blauen blauer grüne grünen gelbe gelben weiße würfel schüssel schale dose kiste"
        " hause unter über neben"
        " hinter vor zwischen auch noch mal jetzt schnell langsam vorsichtig alle alles hier dort tisch"
        " halte lass los zeig"
        " könntest kannst würdest schau becher glas flasche links rechts linke rechte seite"
    ),
    Language("fr", "French"): (
        "le la les un une des du de et ou pas ne est sont dans sur sous avec pour par au aux ce cette ces"
        " mon ma mes ton"
        " moi toi il elle nous vous ils s'il plaît plait mets mettez mettre pose posez poser prends"
        " prenez prendre va allez"
        " aller pousse poussez bol cube rouge bleu bleue vert verte jaune blanc table maison donne donnez"
        " apporte range lâche"
        " ramasse déplace tiens lève puis alors gauche droite côté boîte verre bouteille étagère retourne rentre à"
    ),
    Language("es", "Spanish"): (
        "el la los las un una unos unas y o no es son en sobre con para por del al de que se lo le mi tu su esta este"
        " favor pon ponga poner coloca coloque coge toma tome lleva lleve ve vaya empuja empuje cubo rojo"
        " roja azul verde"
        " amarillo blanco cuenco tazón mesa casa dame suelta agarra levanta mueve mueva luego después"
        " izquierda derecha lado"
        " caja vaso botella estante vuelve regresa recoge taza bol dentro"
    ),
    Language("it", "Italian"): (
        "il lo la i gli le un uno una e o non è sono in nel nella nello sul sulla con per da di del della"
        " che si mi ti per"
        " favore metti mettere mettilo prendi prendere porta vai andare spingi cubo rosso rossa blu verde"
        " giallo bianco ciotola"
        " tavolo casa dammi lascia afferra solleva sposta poi sinistra destra lato scatola bicchiere"
        " bottiglia scaffale torna"
        " dentro scodella"
    ),
    Language("pt", "Portuguese"): (
        "o a os as um uma uns umas e ou não nao é são em no na nos nas sobre com para por do da dos das"
        " que se me te favor"
        " coloque coloca põe ponha pegue pega pegar leve leva vá vai empurre empurra cubo vermelho"
        " vermelha azul verde amarelo"
        " branco tigela mesa casa largue levante mova depois esquerda direita lado caixa copo garrafa"
        " prateleira volte dentro"
    ),
    Language("nl", "Dutch"): (
        "de het een en of niet is zijn in op onder met voor van naar bij dat die dit deze ik jij je hij"
        " wij u alsjeblieft"
        " alstublieft zet leg pak neem breng ga rij duw rode blauwe groene gele witte kubus blok kom"
        " schaal tafel huis geef"
        " laat til beweeg dan daarna links rechts kant doos glas fles plank terug eens doe"
    ),
    Language("sv", "a Scandinavian language"): (
        "en ett den det de och eller inte är i på under med för av till från som jag du han hon vi ni"
        " snälla lägg ställ ta"
        " sätt flytta gå kör knuffa röda blå gröna gula vita kuben skålen bordet hem ge släpp lyft sedan"
        " vänster höger læg"
        " legg på bordet terningen skålen kassen glasset flasken og ikke er den røde blå grønne"
    ),
    Language("pl", "Polish"): (
        "i w na do z ze nie jest są pod nad przy dla od po to ten ta te proszę połóż włóż postaw weź"
        " podnieś idź jedź pchnij"
        " czerwony czerwoną czerwona niebieski niebieskiej zielony kostkę miski miska stół stole domu daj"
        " puść potem lewo"
    ),
    Language("cs", "Czech"): (
        "a v na do z ze ne není je jsou pod nad pro od po to ten ta prosím polož dej vlož vezmi zvedni jdi jeď červenou"
        " červená modré modrá zelenou kostku misky mísy stůl stole domů pusť potom"
    ),
    Language("tr", "Turkish"): (
        "ve veya bir bu şu o de da için ile değil lütfen koy koyun al git götür it kırmızı mavi yeşil"
        " sarı küpü küp kaseye"
        " kase masa masaya eve bırak kaldır sonra içine üzerine"
    ),
    Language("fi", "Finnish"): (
        "ja tai ei on ovat se tämä laita pane ota vie mene aja työnnä punainen sininen vihreä kuutio"
        " kulhoon pöydälle kotiin"
        " anna nosta sitten ole hyvä"
    ),
    Language("hu", "Hungarian"): (
        "a az és vagy nem egy ezt azt van tedd vedd fel menj tolj piros kék zöld kockát tálba asztalra"
        " haza kérlek add emeld"
    ),
    Language("ro", "Romanian"): (
        "un o și sau nu este sunt în pe sub cu pentru la din de care pune ia mergi împinge roșu albastru"
        " verde cubul bolul"
        " masă acasă dă lasă ridică apoi te rog"
    ),
    Language("id", "Indonesian or Malay"): (
        "dan atau tidak di ke dari yang ini itu tolong letakkan taruh ambil pergi dorong merah biru hijau"
        " kubus mangkuk meja"
        " rumah lepaskan angkat lalu dalam"
    ),
    Language("vi", "Vietnamese"): (
        "và hoặc không là trong trên dưới với cho của một cái này đó hãy đặt lấy đi đẩy màu đỏ xanh khối"
        " bát bàn nhà vào"
    ),
}
_ENGLISH_WORDS = frozenset(
    [
        "the",
        "a",
        "an",
        "and",
        "or",
        "not",
        "is",
        "are",
        "be",
        "it",
        "its",
        "this",
        "that",
        "these",
        "those",
        "to",
        "of",
        "in",
        "on",
        "at",
        "into",
        "onto",
        "from",
        "with",
        "for",
        "by",
        "as",
        "if",
        "then",
        "when",
        "i",
        "you",
        "he",
        "she",
        "we",
        "they",
        "me",
        "my",
        "your",
        "his",
        "her",
        "our",
        "their",
        "please",
        "can",
        "could",
        "would",
        "will",
        "should",
        "may",
        "might",
        "must",
        "do",
        "does",
        "go",
        "put",
        "place",
        "move",
        "take",
        "pick",
        "up",
        "drop",
        "push",
        "hold",
        "home",
        "bring",
        "set",
        "get",
        "grab",
        "lift",
        "grasp",
        "let",
        "look",
        "show",
        "point",
        "stop",
        "wait",
        "return",
        "drive",
        "turn",
        "carry",
        "leave",
        "keep",
        "make",
        "give",
        "hand",
        "release",
        "red",
        "blue",
        "green",
        "yellow",
        "orange",
        "purple",
        "white",
        "black",
        "brown",
        "gray",
        "pink",
        "teal",
        "cube",
        "block",
        "bowl",
        "tin",
        "can",
        "box",
        "bottle",
        "glass",
        "table",
        "side",
        "left",
        "right",
        "front",
        "back",
        "shelf",
        "charger",
        "bench",
        "aisle",
        "there",
        "here",
        "now",
        "first",
        "after",
        "before",
        "all",
        "every",
        "each",
        "thing",
        "things",
        "one",
        "ones",
        "robot",
        "arm",
        "gripper",
        "where",
        "what",
        "which",
        "how",
        "no",
        "yes",
        "down",
        "over",
        "under",
        "above",
        "have",
        "has",
        "had",
        "need",
        "want",
        "like",
        "so",
        "but",
        "just",
        "some",
        "any",
        "more",
        "other",
        "out",
        "off",
        "toward",
        "towards",
        "again",
        "away",
        "near",
        "next",
        "place",
    ]
)
_DISTINCT: Mapping[Language, frozenset[str]] = {
    language: frozenset(words.split()) - _ENGLISH_WORDS for language, words in _FUNCTION_WORDS.items()
}
_WORD = re.compile(r"[^\W\d_]+(?:'[^\W\d_]+)?")


def detect_foreign_language(instruction: str) -> Language | None:
    """The language of `instruction` if it is not English; None for English, and for words of no known language."""
    text = unicodedata.normalize("NFC", instruction).casefold().replace("\u2019", "'")
    return _language_of_script(text) or _language_of_words(text)


def is_understood(language: Language, languages: Collection[str]) -> bool:
    """Whether a planner that declares `languages` (ISO 639-1 codes, or "*") reads `language`."""
    return ANY_LANGUAGE in languages or (language.code != "" and language.code in languages)


def _language_of_script(text: str) -> Language | None:
    letters = [character for character in text if character.isalpha()]
    scripts = {unicodedata.name(character, "").partition(" ")[0] for character in set(letters)}
    latin = sum(unicodedata.name(character, "").startswith(("LATIN", "FULLWIDTH LATIN")) for character in letters)
    if latin * 2 > len(letters):
        return None
    for script, language in _SCRIPTS.items():
        if script in scripts:
            return _refine(language, set(letters))
    return Language("", "a language in another script") if letters and not latin else None


def _refine(language: Language, letters: set[str]) -> Language:
    if language.code == "ru" and letters & _UKRAINIAN:
        return Language("uk", "Ukrainian")
    if language.code == "ar" and letters & _PERSIAN:
        return Language("fa", "Persian or Urdu")
    return language


def _language_of_words(text: str) -> Language | None:
    words = _WORD.findall(text)
    english = sum(word in _ENGLISH_WORDS or word.endswith(("n't", "'s", "'m", "'ll", "'re", "'d")) for word in words)
    hits = {language: sum(word in known for word in words) for language, known in _DISTINCT.items()}
    language, best = max(hits.items(), key=lambda item: item[1])
    accented = any(ord(character) > 0x7F for word in words for character in word)
    enough = best >= 2 or (best == 1 and accented) or (best == 1 and len(words) <= 2)
    return language if enough and best > english and best * 4 >= len(words) else None
