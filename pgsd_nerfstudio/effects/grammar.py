"""The little grammar of a text about weather: which words belong together, which are about something else, which are negated.

A text falls into phrases at signs, "and", "with", prepositions. A phrase counts if something in it is weather, or if all of it
describes; what ends in an unknown noun is about something else ("a red truck in purple snow").
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
"""Before a determiner these name a place, else a manner: "in the dark", "in gold", "in a pale blue"."""
LINKS = LEADS | _words("and or but with while which who where when is are was as like of by for plus then")
SILENT = _words(
    """it it's there be being do does will would make makes add let us me i want wants show give please create put some any all
    every fall falls falling fell down coming come comes going go moving flying fly flies drift drifts float floats swirl air
    sky everywhere ground surfaces surface effect weather color colored colors colour coloured colours full lots lot"""
)
"""Words that say nothing here and need no mention."""


@dataclass(frozen=True)
class Item:
    """One to three words that mean one thing; nothing where they are unknown."""

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
        return all(v is None for v in (self.kind, self.wind, self.quality, self.rgb, self.tint, self.degree))


@dataclass
class Phrase:
    """Words that belong together."""

    items: list[Item] = field(default_factory=list)
    place: bool = False
    """It says where: colours and sizes there are not the weather's."""

    @property
    def counts(self) -> bool:
        """Whether it is about the weather."""
        if any(item.kind or item.wind for item in self.items):
            return True
        return not self.place and not self.items[-1].unknown


def parse(text: str) -> tuple[list[Phrase], str]:
    """The phrases of a text, and the text without what it does not want."""
    tokens = re.findall(r"\w+(?:'\w+)*|[,.;:!?()\n]", unicodedata.normalize("NFKC", text).lower().translate(PLAIN))
    phrases: list[Phrase] = [Phrase()]
    spoken: list[str] = []
    excluded = inverted = led = False
    at = 0
    while at < len(tokens):
        token = tokens[at].replace("'", "")
        found, count = _longest([word.replace("'", "") for word in tokens[at : at + 3]])
        heard = tokens[at : at + count]
        at += count
        if found:
            phrases[-1].items.append(replace(found, negated=excluded or inverted))
            heard = [] if excluded or inverted else heard
            inverted = led = False
        elif token in NEGATIONS:
            inverted, heard = True, []
        elif token in EXCLUSIONS | PLACES | LINKS or not token[0].isalnum():
            joins = token in {"and", "or", "nor"}
            phrases.append(Phrase(place=token in PLACES or (joins and phrases[-1].place)))
            excluded = token in EXCLUSIONS or (excluded and token == "or")
            led = token in LEADS
        else:
            if token in DETERMINERS:
                phrases[-1].place |= led
            elif token not in ARTICLES and heard[0] not in SILENT:
                phrases[-1].items.append(Item(token))
            led = False
        spoken += [] if excluded else heard
    return [phrase for phrase in phrases if phrase.items], _sentence(spoken)


PLAIN = str.maketrans({"’": "'", "_": " ", "{": " ", "}": " "})


def _longest(tokens: list[str]) -> tuple[Item | None, int]:
    """What the next words mean, most words first, and how many they are."""
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


def _sentence(spoken: list[str]) -> str:
    """Words in a row, without the links that nothing follows since what followed was not wanted."""
    dangling = LINKS | PLACES | ARTICLES | DETERMINERS | {"it's", "do", "does", "it"}
    kept: list[str] = []
    for token in reversed(spoken):
        after = kept[-1] if kept else None
        ends = after is None or not after[0].isalnum() or after in {"and", "but", "or"}
        if ends and (token in dangling or not token[0].isalnum()):
            continue
        kept.append(token)
    while kept and (kept[-1] in LINKS or not kept[-1][0].isalnum()):
        kept.pop()
    return re.sub(r" (?=[,.;:!?()])", "", " ".join(reversed(kept)))
