"""A request for weather as plain numbers: the form in which the reader or a language model answers a free text.

A request changes a base effect by factors and colours; `application` applies them to the Effect. The limits keep every answer
within the range that was simulated and looked at, so that a strange answer gives strange weather and not a crash.
"""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal, get_args

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

Base = Literal["snowfall", "rainfall", "fog", "sandstorm"]
BASES: tuple[Base, ...] = get_args(Base)

Share = Annotated[float, Field(ge=0, le=1)]
Rgb = tuple[Share, Share, Share]


# Strict, since a number in quotes or a truth value for a colour shows that the field was misunderstood.
STRICT = ConfigDict(extra="forbid", strict=True, use_attribute_docstrings=True)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Request:
    """The weather that a text asks for. Factors multiply the numbers of the base effect; 1 keeps them."""

    base: Base | None
    """The effect that moves most like it: snowfall (sways down slowly, lands, accumulates), rainfall (falls fast, wets), fog
    (hangs and drifts), sandstorm (moves sideways with the wind). null: the text names nothing that could be in the air."""
    rgb: Rgb | None = None
    """Colour of the particles in the air, sRGB. null keeps the base's. By default it tints the base's matter: purple snow is
    nearly as bright as snow."""
    landed_rgb: Rgb | None = None
    """Colour of the particles that have landed, sRGB. null: the colour of those in the air."""
    dyed: bool = False
    """Whether the colours are those of the particles' own matter, exactly, since they are no snow, rain, fog or sand: petals,
    leaves, confetti, ash, smoke, embers."""
    colourful: bool = False
    """Whether each particle has a hue of its own: confetti, rainbow snow."""
    size: Annotated[float, Field(ge=0.2, le=5)] = 1.0
    """Factor on the diameter of the particles (the base's snowflakes have 1.5-12 mm)."""
    amount: Annotated[float, Field(ge=0.1, le=5)] = 1.0
    """Factor on the precipitation or the density: 0.4 is light, 2 heavy, 4 a blizzard or downpour."""
    opacity: Annotated[float, Field(ge=0.1, le=2)] = 1.0
    """Factor on the opacity of each particle."""
    glitter: Share = 0.0
    """How much the particles flash as they turn, by mirroring light: 0 not at all, 0.7 glittering, 1 like tinsel."""
    glow: Share = 0.0
    """How much light the particles send out themselves: 0 none, 0.5 glowing, 1 embers, fireflies, magic."""
    twinkle: Annotated[float, Field(ge=0, le=5)] = 0.0
    """Pulses of each particle's brightness per second: 0 steady, 0.5 fireflies, 1 magic, 2 stars."""
    fall_speed: Annotated[float, Field(ge=0.2, le=3)] = 1.0
    """Factor on the speed of falling in still air."""
    wind: Annotated[float, Field(ge=0, le=3)] = 1.0
    """Factor on the wind and its gusts; 0 is still air."""
    tumbling: Annotated[float, Field(ge=0, le=5)] = 1.0
    """Factor on the swaying and turning of each particle by itself; leaves and confetti have about 3."""
    accumulates: bool | None = None
    """Whether particles that land stay and form a cover. null keeps what the base does."""
    prompt: Annotated[str, Field(max_length=600, pattern=r"^[^{}\n]*\{scene\}[^{}\n]*$")]
    """One English sentence that describes the video for a video model, with {scene} in place of the description of the scene,
    such as: Purple snowflakes are falling in {scene}, accumulating on surfaces. Photorealistic, high detail"""

    @staticmethod
    def from_json(text: str) -> Request:
        """Read a request from a JSON object.

        Raises:
            ValueError: the text is not JSON, or has unknown fields, wrong types or numbers out of range; the message names each
                such field, what is allowed and what was found.
        """
        try:
            return ADAPTER.validate_json(text)
        except ValidationError as error:
            faults = error.errors(include_url=False)
        raise ValueError("; ".join(_fault(fault) for fault in faults))

    def to_json(self) -> str:
        """The JSON object of this request, all fields written out."""
        return ADAPTER.dump_json(self, indent=2).decode()


ADAPTER = TypeAdapter(Request)
SCHEMA: dict[str, Any] = ADAPTER.json_schema()
"""JSON schema of a request with its descriptions, which a language model is given."""
LIMITS: dict[str, tuple[float, float]] = {
    name: (field["minimum"], field["maximum"]) for name, field in SCHEMA["properties"].items() if "minimum" in field
}
"""Least and greatest value of each factor."""


def _fault(fault: Any) -> str:
    if fault["type"] == "json_invalid":
        return f"a request must be one JSON object, found {_short(fault['input'])} ({fault['ctx']['error']})"
    if not fault["loc"]:
        return f"a request must be a JSON object, found {_short(fault['input'])}"
    name, *within = fault["loc"]
    if name not in SCHEMA["properties"]:
        return (
            f"{name} is no field of a request, found {_short(fault['input'])}; its fields are {', '.join(SCHEMA['properties'])}"
        )
    allowed = _allowed(SCHEMA["properties"][name])
    if fault["type"] == "missing":
        return f"{name} must be {allowed}, found {'too few' if within else 'none'}"
    return f"{name} must be {allowed}, found {_short(fault['input'])}{f' at place {within[0] + 1}' if within else ''}"


def _allowed(field: dict[str, Any]) -> str:
    """The values that the schema of a field allows, in words."""
    if "anyOf" in field:
        return " or ".join(_allowed(choice) for choice in field["anyOf"])
    if "enum" in field:
        return f"one of {', '.join(field['enum'])}"
    kind = field["type"]
    if kind == "number":
        return f"a number in {field['minimum']:g}-{field['maximum']:g}"
    if kind == "array":
        return f"a list of {field['minItems']}, each {_allowed(field['prefixItems'][0])}"
    if kind == "string":
        return f"one line of at most {field['maxLength']} characters with {{scene}} once and no other braces"
    return {"boolean": "true or false", "null": "null"}[kind]


def _short(found: Any) -> str:
    try:
        words = json.dumps(found, ensure_ascii=False)
    except TypeError:
        words = repr(found)
    return words if len(words) <= 60 else f"{words[:57]}..."
