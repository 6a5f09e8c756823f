"""Read a request for weather from words, without a network: `read("glittering yellow sand, no wind").request`.

The reader knows only the words of vocabulary.py, and reports which words it used and which it ignored. A language model
(language_model.py) understands more; the reader needs no network and always gives the same answer.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass, field

from matplotlib.colors import CSS4_COLORS

from pgsd_nerfstudio.effects.effect import EFFECTS
from pgsd_nerfstudio.effects.grammar import LINKS, PLACES, Item, Phrase, parse
from pgsd_nerfstudio.effects.request import LIMITS, Base, Request, Rgb
from pgsd_nerfstudio.effects.tint import in_matter
from pgsd_nerfstudio.effects.vocabulary import KINDS, NOMINAL, QUALITIES, WINDS, Kind, forms, mixed, tinted

NO_WEATHER = (
    "names nothing that could be in the air; say what falls or drifts, such as: purple snow, heavy rain, thin pale fog, "
    "glittering yellow sand, slowly falling ash, pink petals, magic particles"
)
SHARES = ("glitter", "glow")
LIGHTS = (*SHARES, "twinkle")  # what particles do with light, which they do not unless it is said
LONGEST = 400  # characters; a video model reads about 226 tokens
MOTION: dict[Base, str] = {
    "snowfall": "falling in",
    "rainfall": "falling in",
    "fog": "moving across",
    "sandstorm": "swirling through",
}


@dataclass(frozen=True)
class Reading:
    """A request, and the words that it was read from."""

    request: Request
    understood: tuple[str, ...]
    """Words with their meaning, such as "purple = colour (0.50, 0.00, 0.50)"."""
    ignored: tuple[str, ...]
    """Words that were not used; an unknown word comes with a known one that resembles it."""

    def __str__(self) -> str:
        understood = f"understood {'; '.join(self.understood)}"
        return f"{understood}. Ignored: {', '.join(self.ignored)}" if self.ignored else understood


def read(text: str) -> Reading:
    """Read the request in a text, as far as its words are known.

    Raises:
        ValueError: the text is empty or longer than 400 characters, or names nothing that could be in the air.
    """
    check_length(text)
    phrases, wanted = parse(text)
    findings = Findings()
    for phrase in phrases:
        findings.add(phrase)
    kind = findings.choose()
    if kind is None:
        guess = next((guess for word in re.findall(r"\w{3,}", text.lower()) if (guess := _meant(word, KINDS))), None)
        raise ValueError(f"{text.strip()!r} {NO_WEATHER}{f'; was {guess!r} meant?' if guess else ''}")
    return Reading(_request(findings, kind, wanted), tuple(findings.understood), tuple(findings.ignored))


def check_length(text: str) -> None:
    """Check the length of a text, for the reader and for language models.

    Raises:
        ValueError: the text is not 1-400 characters long.
    """
    if not 0 < len(text.strip()) <= LONGEST:
        raise ValueError(f"a text for the weather must have 1-{LONGEST} characters, found {len(text.strip())}")


@dataclass
class Findings:
    """Meanings of the phrases that have been read so far."""

    kinds: list[tuple[str, Kind]] = field(default_factory=list)
    colours: list[Rgb] = field(default_factory=list)
    tints: list[tuple[str, float]] = field(default_factory=list)
    """Tints without a colour, with their degree; they apply to the weather's own colour."""
    factors: dict[str, float | bool] = field(default_factory=dict)
    denied: dict[str, float | bool] = field(default_factory=dict)
    """Values of fields that negated words ask for."""
    understood: list[str] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)

    def add(self, phrase: Phrase) -> None:
        """Add the meanings of the words of a phrase."""
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
                self.ignored.append(item.words)  # "ash grey snow" is snow
            else:
                self._describe(item, degree, airy)
            degree = 1.0

    def choose(self) -> Kind | None:
        """The first kind of the highest rank; the other kinds are ignored. None if there is no kind."""
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
            # "Strong", "light" and "fast" in a phrase about wind give one factor of the wind.
            wanted = {"wind": next((wanted[name] for name in ("wind", "amount", "size", "fall_speed") if name in wanted), 1.0)}
        for name, value in wanted.items():
            if not isinstance(value, bool):
                wanted[name] = 1 - (1 - value) ** degree if name in SHARES else value**degree
        if item.wind:
            wanted["wind"] = item.wind
        if item.kind:
            self.kinds.append((item.words, item.kind))
        _combine(self.factors, wanted)
        meanings = [*map(_said, wanted.items())]
        if item.tint and not item.quality:
            self.tints.append((item.tint, degree))
            meanings.append("tint of its own colour")
        if meanings:
            self.understood.append(f"{item.words} = {', '.join(meanings)}")

    def _deny(self, item: Item) -> None:
        """Add a negated word. Some qualities have a clear opposite; "not heavy" has none and is ignored."""
        quality = item.quality or {}
        denied: dict[str, float | bool] = {name: 0.0 for name in (*LIGHTS, "tumbling") if name in quality}
        if item.wind or (quality.get("wind", 0) > 1 and not item.kind):
            denied["wind"] = 0.0
        if "colourful" in quality:
            denied["colourful"] = False
        if "accumulates" in quality:
            denied["accumulates"] = not quality["accumulates"]
        self.denied |= denied
        known = self.understood if denied or item.kind else self.ignored
        known.append(f"not {item.words}")


def _combine(factors: dict[str, float | bool], more: dict[str, float | bool]) -> None:
    """Add `more` to `factors`: factors multiply, the greater glitter, glow and twinkle count, the last truth value counts."""
    for name, value in more.items():
        if isinstance(value, bool) or name not in factors:
            factors[name] = value
        else:
            factors[name] = max(factors[name], value) if name in LIGHTS else factors[name] * value


def _said(factor: tuple[str, float | bool]) -> str:
    """A factor or a truth value in words."""
    name, value = factor
    return f"{name.replace('_', ' ')} {value:.2g}" if not isinstance(value, bool) else name if value else f"{name} not"


def _leads_to_colour(rest: list[Item]) -> bool:
    """Whether a colour follows, after tints and degrees only."""
    following = next((item for item in rest if not (item.tint or item.degree)), None)
    return following is not None and following.rgb is not None


def _meant(word: str, known: list[str] | dict[str, Kind]) -> str | None:
    """A known word that an unknown word resembles; None for a known word."""
    close = [] if word in known else difflib.get_close_matches(word, known, n=1, cutoff=0.8)
    return close[0] if close else None


def _request(findings: Findings, kind: Kind, wanted: str) -> Request:
    rgb, dyed = kind.rgb, kind.dyed or kind.rgb is not None
    if findings.colours:
        findings.factors.setdefault("colourful", False)
        rgb = mixed(findings.colours)
        if kind.rgb is not None and not kind.dyed:
            rgb = in_matter(kind.rgb, rgb, EFFECTS[kind.base].emission.kind)
    elif findings.tints:
        dyed = True  # of its own colour, so that there is nothing to tint
    for tint, degree in findings.tints:
        rgb = tinted(rgb or NOMINAL[kind.base], tint, degree)
    values = dict(kind.factors)
    _combine(values, findings.factors)
    values |= findings.denied
    for name, (least, greatest) in LIMITS.items():
        if name in values:
            bounded = min(max(values[name], least), greatest)
            if bounded != values[name]:
                findings.understood.append(f"{_said((name, values[name]))} is beyond the limit: {bounded:g}")
            values[name] = round(bounded, 3)
    return Request(
        base=kind.base,
        rgb=rgb,
        landed_rgb=kind.landed_rgb or rgb,
        dyed=dyed,
        prompt=_sentence(wanted, kind.base, values.get("accumulates")),
        **values,  # pyright: ignore[reportArgumentType]
    )


def _sentence(wanted: str, base: Base, accumulates: float | bool | None) -> str:
    """The prompt for a video model, in the style of the built-in effects, from the text without its negated words."""
    end = "" if base == "fog" else ", wetting the surfaces" if base == "rainfall" else ", accumulating on surfaces"
    if accumulates is not None:
        end = ", accumulating on surfaces" if accumulates else ""
    last = wanted.rpartition(" ")[2]
    links = set(wanted.split()) & (LINKS - {"and", "of"} | PLACES)
    # "Purple snow" needs a verb, "a snow storm" implies one, and a longer text is a clause by itself.
    if not any(form in KINDS for form in forms(last)) or last.endswith("ing") or links or re.search(r"[,.;:!?()]", wanted):
        return f"In {{scene}}: {wanted}{end}. Photorealistic, high detail"
    moves = last in QUALITIES or last.endswith(("storm", "fall")) or set(wanted.split()) & {"falling", "raining", "snowing"}
    verb = "in" if moves else MOTION[base]
    return f"{wanted[:1].upper()}{wanted[1:]} {verb} {{scene}}{end}. Photorealistic, high detail"
