"""Reads a request for weather from words, without a network: `read("glittering yellow sand, no wind").request`.

It knows the words of vocabulary.py and no others, and says which it used and which it did not. A language model
(asking.py) understands more; this reader is there at once, and gives the same answer every time.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass, field

from matplotlib.colors import CSS4_COLORS

from pgsd_nerfstudio.effects.grammar import LINKS, PLACES, Item, Phrase, parse
from pgsd_nerfstudio.effects.request import LIMITS, Base, Request, Rgb
from pgsd_nerfstudio.effects.vocabulary import KINDS, NOMINAL, QUALITIES, WINDS, Kind, forms, mixed, tinted

NO_WEATHER = (
    "names nothing that could be in the air; say what falls or drifts, such as: purple snow, heavy rain, thin pale fog, "
    "glittering yellow sand, slowly falling ash, pink petals, magic particles"
)
LONGEST = 400  # characters; a video model reads about 226 tokens
MOTION: dict[Base, str] = {
    "snowfall": "falling in",
    "rainfall": "falling in",
    "fog": "moving across",
    "sandstorm": "swirling through",
}


@dataclass(frozen=True)
class Reading:
    """A request, and how it was found."""

    request: Request
    understood: tuple[str, ...]
    """Such as "purple = colour (0.50, 0.00, 0.50)"."""
    ignored: tuple[str, ...]
    """Words that had no part in it, with a known word that an unknown one resembles."""

    def __str__(self) -> str:
        said = f"understood {'; '.join(self.understood)}"
        return f"{said}. Ignored: {', '.join(self.ignored)}" if self.ignored else said


def read(text: str) -> Reading:
    """What the text requests for, as far as its words are known.

    Raises:
        ValueError: it is empty or longer than 400 characters, or names no weather and nothing else that could be in the air.
    """
    check(text)
    phrases, spoken = parse(text)
    sheet = Sheet()
    for phrase in phrases:
        sheet.take(phrase)
    kind = sheet.choose()
    if kind is None:
        guess = next((guess for word in re.findall(r"\w{3,}", text.lower()) if (guess := _meant(word, KINDS))), None)
        raise ValueError(f"{text.strip()!r} {NO_WEATHER}{f'; was {guess!r} meant?' if guess else ''}")
    return Reading(_request(sheet, kind, spoken), tuple(sheet.understood), tuple(sheet.ignored))


def check(text: str) -> None:
    """Refuse a text that is empty or too long to be read by anyone.

    Raises:
        ValueError: it is not 1-400 characters long.
    """
    if not 0 < len(text.strip()) <= LONGEST:
        raise ValueError(f"a text for the weather must have 1-{LONGEST} characters, found {len(text.strip())}")


@dataclass
class Sheet:
    """What has been read so far."""

    kinds: list[tuple[str, Kind]] = field(default_factory=list)
    colours: list[Rgb] = field(default_factory=list)
    tints: list[tuple[str, float]] = field(default_factory=list)
    """Tints without a colour: of the weather's own."""
    factors: dict[str, float | bool] = field(default_factory=dict)
    denied: dict[str, float | bool] = field(default_factory=dict)
    understood: list[str] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)

    def take(self, phrase: Phrase) -> None:
        """Add what a phrase says."""
        items = phrase.items
        if not phrase.counts:
            self.ignored.append(" ".join(item.words for item in items))
            return
        airy = any(item.wind for item in items) and not any(item.kind for item in items)
        degree: float = 1.0
        waiting: list[tuple[str, float]] = []
        for item, rest in ((item, items[at + 1 :]) for at, item in enumerate(items)):
            if item.degree and not item.quality:
                degree = item.degree
                continue
            if item.unknown:
                guess = _meant(item.words, [*KINDS, *QUALITIES, *WINDS, *CSS4_COLORS])
                self.ignored.append(f"{item.words} ({guess}?)" if guess else item.words)
            elif item.negated:
                self._deny(item)
            elif item.tint and _leads_to_colour(rest):
                waiting.append((item.tint, degree))
            elif item.rgb:
                self._paint(item.words, item.rgb, waiting)
                waiting = []
            elif item.kind and rest and rest[0].rgb and any(other.kind for other in rest):
                self.ignored.append(item.words)  # ash grey snow is snow
            else:
                self._describe(item, degree, airy)
            degree = 1.0

    def choose(self) -> Kind | None:
        """The kind that is meant: of those with the highest rank the first; the others are ignored."""
        if not self.kinds:
            return None
        chosen = max((kind for _, kind in self.kinds), key=lambda kind: kind.rank)
        for words, kind in self.kinds:
            if kind is chosen:
                self.understood.insert(0, " = ".join([words, ", ".join([kind.base, *map(_said, kind.factors.items())])]))
            elif kind.base != chosen.base and words not in QUALITIES:
                self.ignored.append(f"{words} (one kind at a time)")
        return chosen

    def _paint(self, words: str, rgb: Rgb, tints: list[tuple[str, float]]) -> None:
        for tint, degree in reversed(tints):
            rgb = tinted(rgb, tint, degree)
        self.colours.append(rgb)
        name = " ".join([*(tint for tint, _ in tints), words])
        self.understood.append(f"{name} = colour ({', '.join(f'{c:.2f}' for c in rgb)})")

    def _describe(self, item: Item, degree: float, airy: bool) -> None:
        wanted = dict(item.quality or {})
        if airy and wanted:
            # A strong, a light, a fast wind: one number, of the wind.
            wanted = {"wind": next((wanted[name] for name in ("wind", "amount", "size", "fall_speed") if name in wanted), 1.0)}
        for name, value in wanted.items():
            if not isinstance(value, bool):
                wanted[name] = 1 - (1 - value) ** degree if name == "glitter" else value**degree
        if item.wind:
            wanted["wind"] = item.wind
        if item.kind:
            self.kinds.append((item.words, item.kind))
        _combine(self.factors, wanted)
        said = [*map(_said, wanted.items())]
        if item.tint and not item.quality:
            self.tints.append((item.tint, degree))
            said.append("tint of its own colour")
        if said:
            self.understood.append(f"{item.words} = {', '.join(said)}")

    def _deny(self, item: Item) -> None:
        """What is not wanted; of "not heavy" nobody knows the contrary."""
        quality = item.quality or {}
        denied: dict[str, float | bool] = {name: 0.0 for name in ("glitter", "tumbling") if name in quality}
        if item.wind or (quality.get("wind", 0) > 1 and not item.kind):
            denied["wind"] = 0.0
        if "accumulates" in quality:
            denied["accumulates"] = not quality["accumulates"]
        self.denied |= denied
        known = self.understood if denied or item.kind else self.ignored
        known.append(f"not {item.words}")


def _combine(factors: dict[str, float | bool], more: dict[str, float | bool]) -> None:
    """Factors multiply, of glitter the greater counts, of yes and no the last."""
    for name, value in more.items():
        if isinstance(value, bool) or name not in factors:
            factors[name] = value
        else:
            factors[name] = max(factors[name], value) if name == "glitter" else factors[name] * value


def _said(factor: tuple[str, float | bool]) -> str:
    name, value = factor
    return f"{name.replace('_', ' ')} {value:.2g}" if not isinstance(value, bool) else name if value else f"{name} not"


def _leads_to_colour(rest: list[Item]) -> bool:
    following = next((item for item in rest if not (item.tint or item.degree)), None)
    return following is not None and following.rgb is not None


def _meant(word: str, known: list[str] | dict[str, Kind]) -> str | None:
    """A known word that an unknown one resembles."""
    close = [] if word in known else difflib.get_close_matches(word, known, n=1, cutoff=0.8)
    return close[0] if close else None


def _request(sheet: Sheet, kind: Kind, spoken: str) -> Request:
    rgb = mixed(sheet.colours) if sheet.colours else kind.rgb
    for tint, degree in sheet.tints:
        rgb = tinted(rgb or NOMINAL[kind.base], tint, degree)
    values = dict(kind.factors)
    _combine(values, sheet.factors)
    values |= sheet.denied
    for name, (least, greatest) in LIMITS.items():
        if name in values:
            bounded = min(max(values[name], least), greatest)
            if bounded != values[name]:
                sheet.understood.append(f"{_said((name, values[name]))} is beyond the limit: {bounded:g}")
            values[name] = round(bounded, 3)
    return Request(
        base=kind.base,
        rgb=rgb,
        landed_rgb=kind.landed_rgb or rgb,
        prompt=_sentence(spoken, kind.base, values.get("accumulates")),
        **values,  # pyright: ignore[reportArgumentType]
    )


def _sentence(spoken: str, base: Base, accumulates: float | bool | None) -> str:
    """What a video model is told, in the manner of the built-in effects."""
    end = "" if base == "fog" else ", wetting the surfaces" if base == "rainfall" else ", accumulating on surfaces"
    if accumulates is not None:
        end = ", accumulating on surfaces" if accumulates else ""
    last = spoken.rpartition(" ")[2]
    links = set(spoken.split()) & (LINKS - {"and", "of"} | PLACES)
    # "Purple snow" needs a verb; "a snow storm" has one in it; anything longer is a clause by itself.
    if not any(form in KINDS for form in forms(last)) or last.endswith("ing") or links or re.search(r"[,.;:!?()]", spoken):
        return f"In {{scene}}: {spoken}{end}. Photorealistic, high detail"
    moves = last in QUALITIES or last.endswith(("storm", "fall")) or set(spoken.split()) & {"falling", "raining", "snowing"}
    verb = "in" if moves else MOTION[base]
    return f"{spoken[:1].upper()}{spoken[1:]} {verb} {{scene}}{end}. Photorealistic, high detail"
