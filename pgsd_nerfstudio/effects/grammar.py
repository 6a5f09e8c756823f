"""A small grammar for texts about weather: which words belong together, which describe something else, which are negated.

A text is cut into phrases at punctuation, "and", "with" and prepositions. A phrase counts if it names a weather, or if it only
describes one; a phrase that ends in an unknown noun describes something else ("a red truck in purple snow").
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass, field, replace

from pgsd_nerfstudio.effects.request import Rgb
from pgsd_nerfstudio.effects.vocabulary import DEGREES, KINDS, QUALITIES, TINTS, WINDS, Kind, colour, forms


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


NEGATIONS = _words("not never hardly dont doesnt isnt arent wont cannot cant")
EXCLUSIONS = _words("no without nor lacking sans")
PLACES = _words("on onto over above across against around behind beside near under below beneath at into inside upon between")
ARTICLES = _words("a an")
DETERMINERS = _words("the my our your this that these those its")
LEADS = _words("in through from to")
"""Prepositions that lead to a place before a determiner ("in the dark"), else to a manner ("in gold", "in a pale blue")."""
LINKS = LEADS | _words("and or but with while which who where when is are was as like of by for plus then")
SILENT = _words(
    """it it's there be being do does will would make makes add let us me i want wants show give please create put some any all
    every fall falls falling fell down coming come comes going go moving flying fly flies drift drifts float floats swirl air
    sky everywhere ground surfaces surface effect weather color colored colors colour coloured colours full lots lot"""
)
"""Words without a meaning for the weather, which are skipped without a report."""


@dataclass(frozen=True)
class Item:
    """One to three words with one meaning; all meanings are None if the words are unknown."""

    words: str
    kind: Kind | None = None
    wind: float | None = None
    quality: dict[str, float | bool] | None = None
    rgb: Rgb | None = None
    tint: str | None = None
    degree: float | None = None
    negated: bool = False

    @property
    def unknown(self) -> bool:
        """Whether the words have no meaning here."""
        return all(v is None for v in (self.kind, self.wind, self.quality, self.rgb, self.tint, self.degree))


@dataclass
class Phrase:
    """Words that belong together."""

    items: list[Item] = field(default_factory=list)
    place: bool = False
    """The phrase names a place, so that its colours and sizes do not describe the weather."""

    @property
    def counts(self) -> bool:
        """Whether the phrase is about the weather."""
        if any(item.kind or item.wind for item in self.items):
            return True
        return not self.place and not self.items[-1].unknown


def parse(text: str) -> tuple[list[Phrase], str]:
    """Cut a text into phrases.

    Returns:
        The phrases that hold words, and the text without its negated words.
    """
    tokens = re.findall(r"\w+(?:'\w+)*|[,.;:!?()\n]", unicodedata.normalize("NFKC", text).lower().translate(PLAIN))
    phrases: list[Phrase] = [Phrase()]
    wanted: list[str] = []
    excluded = inverted = led = False
    at = 0
    while at < len(tokens):
        token = tokens[at].replace("'", "")
        found, count = _longest([word.replace("'", "") for word in tokens[at : at + 3]])
        words = tokens[at : at + count]
        at += count
        if found:
            phrases[-1].items.append(replace(found, negated=excluded or inverted))
            words = [] if excluded or inverted else words
            inverted = led = False
        elif token in NEGATIONS:
            inverted, words = True, []
        elif token in EXCLUSIONS | PLACES | LINKS or not token[0].isalnum():
            joins = token in {"and", "or", "nor"}
            phrases.append(Phrase(place=token in PLACES or (joins and phrases[-1].place)))
            excluded = token in EXCLUSIONS or (excluded and token == "or")
            led = token in LEADS
        else:
            if token in DETERMINERS:
                phrases[-1].place |= led
            elif token not in ARTICLES and words[0] not in SILENT:
                phrases[-1].items.append(Item(token))
            led = False
        wanted += [] if excluded else words
    return [phrase for phrase in phrases if phrase.items], _joined(wanted)


PLAIN = str.maketrans({"’": "'", "_": " ", "{": " ", "}": " "})


def _longest(tokens: list[str]) -> tuple[Item | None, int]:
    """The meaning of the next words and their number; as many words as possible are taken together."""
    for count in range(len(tokens), 0, -1):
        for form in forms(tokens[count - 1]):
            name = " ".join([*tokens[: count - 1], form])
            tint = name if name in TINTS else None
            found = Item(
                " ".join(tokens[:count]),
                *(KINDS.get(name), WINDS.get(name), QUALITIES.get(name), colour(name), tint, DEGREES.get(name)),
            )
            if not found.unknown:
                return found, count
    return None, 1


def _joined(wanted: list[str]) -> str:
    """The words as one text, without links and articles whose words were negated and left out."""
    dangling = LINKS | PLACES | ARTICLES | DETERMINERS | {"it's", "do", "does", "it"}
    kept: list[str] = []
    for token in reversed(wanted):
        after = kept[-1] if kept else None
        ends = after is None or not after[0].isalnum() or after in {"and", "but", "or"}
        if ends and (token in dangling or not token[0].isalnum()):
            continue
        kept.append(token)
    while kept and (kept[-1] in LINKS or not kept[-1][0].isalnum()):
        kept.pop()
    return re.sub(r" (?=[,.;:!?()])", "", " ".join(reversed(kept)))
