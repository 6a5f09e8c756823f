"""Ask a language model for the numbers of a request (paper, appearance initialization), and store its answer.

Keys and addresses are never stored. Not every server knows structured output, so the instructions hold the schema of a
request, and Request.from_json checks the answer. If the model does not answer, the reader answers instead only if the caller
allows it.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from pgsd_nerfstudio.effects.connection import Connection, LanguageModelError, line_of
from pgsd_nerfstudio.effects.reader import NO_WEATHER, check_length, read
from pgsd_nerfstudio.effects.request import SCHEMA, Request
from pgsd_nerfstudio.storage import atomic_write, content_key
from pgsd_nerfstudio.storage import cache_dir as shared_cache

LONGEST = 100_000  # characters of an answer; a request has some hundred
INSTRUCTIONS = f"""\
You turn a short description of weather, or of anything else that fills the air, into numbers for a simulation of particles in a
3D Gaussian Splatting scene: how they look, in the air and landed, and how they move. The numbers change one of four base
effects; choose the one that moves most like what is described, and numbers that a physicist and a painter would accept.
Leave at its default whatever the description says nothing about. If nothing in it could be in the air, base is null.
Answer with one JSON object and nothing else. It must satisfy this JSON schema:
{json.dumps(SCHEMA)}"""


@dataclass(frozen=True, kw_only=True)
class Understanding:
    """A request, and the reader or the model that made it."""

    request: Request
    by: str
    """The model, or the word "reader"."""
    remark: str
    """One text for the user: which model was asked and what it answered, or which words the reader used and ignored. If a model
    was asked first, it also tells why the reader answered instead."""


def request_for(
    prompt: str,
    *,
    model: str | None = None,
    base_url: str | None = None,
    cache_dir: Path | None = None,
    timeout: float = 60.0,
    reader_fallback: bool = False,
) -> Understanding:
    """The request of a text, from a language model if one is named, else from the built-in reader.

    Args:
        prompt: the text, 1-400 characters.
        model: as for `ask`; None: the reader reads the text.
        base_url: as for `ask`.
        cache_dir: as for `ask`; None: the folder `requests` of the common cache.
        timeout: as for `ask`.
        reader_fallback: let the reader answer if the model gives no usable answer; the remark then says so.

    Raises:
        LanguageModelError: the model gave no usable answer, and `reader_fallback` is False.
        ValueError: the text is empty, too long or names nothing that could be in the air.
        OSError: the answer of a model cannot be stored.
    """
    if model is None:
        reading = read(prompt)
        return Understanding(request=reading.request, by="reader", remark=str(reading))
    folder = cache_dir or shared_cache() / "requests"
    try:
        request = ask(prompt, model=model, base_url=base_url, cache_dir=folder, timeout=timeout)
    except LanguageModelError as error:
        if not reader_fallback:
            raise
        try:
            reading = read(prompt)
        except ValueError as unread:
            raise ValueError(f"{error}. The built-in reader was asked instead: {unread}") from error
        return Understanding(
            request=reading.request, by="reader", remark=f"{error}. The built-in reader answers instead: {reading}"
        )
    return Understanding(
        request=request, by=model, remark=f"{model} was asked what {prompt.strip()!r} means: {_summary(request)}"
    )


def _summary(request: Request) -> str:
    """One line with the fields of a request that are not at their defaults."""
    defaults = {field.name: field.default for field in fields(Request)}
    changed = {name: value for name in defaults if (value := getattr(request, name)) != defaults[name] and name != "prompt"}
    base = changed.pop("base")
    return ", ".join([str(base), *(f"{name.replace('_', ' ')} {_written(value)}" for name, value in changed.items())])


def _written(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"({', '.join(f'{c:.2f}' for c in value)})" if isinstance(value, tuple) else f"{value:.2g}"


def ask(prompt: str, *, model: str, base_url: str | None = None, cache_dir: Path, timeout: float = 60.0) -> Request:
    """The request of a text from a language model. The same question is asked once, and its answer is stored.

    Args:
        prompt: the text, 1-400 characters.
        model: PROVIDER:NAME, such as "openai:gpt-5-mini".
        base_url: address of the server; None: the provider's own or the one in the environment.
        cache_dir: folder of the answers, one request-HASH.json each, with the hash of prompt, model, address and instructions.
        timeout: seconds to wait for an answer, in each of two tries.

    Raises:
        LanguageModelError: the library is not installed, the model cannot be reached, does not answer in time, refuses, or
            twice gives an unusable answer; or a stored answer is damaged.
        ValueError: the text is empty, too long, or names nothing that could be in the air.
        OSError: the answer cannot be stored.
    """
    check_length(prompt)
    prompt = prompt.strip()
    path = cache_dir / f"request-{content_key(prompt, model, base_url, INSTRUCTIONS)}.json"
    if path.is_file():
        request = _stored(path)
    else:
        request = _asked(prompt, model, base_url, timeout)
        answer = {"prompt": prompt, "model": model, "request": json.loads(request.to_json())}
        with atomic_write(path) as temporary:
            temporary.write_text(json.dumps(answer, indent=2, ensure_ascii=False) + "\n", "utf-8")
    if request.base is None:
        raise ValueError(f"{prompt!r} {NO_WEATHER} (so says {model})")
    return request


def _asked(prompt: str, model: str, base_url: str | None, timeout: float) -> Request:
    connection = Connection.open(model, base_url, timeout)
    messages = [{"role": "system", "content": INSTRUCTIONS}, {"role": "user", "content": prompt}]
    answer = connection.answer(messages)
    try:
        return Request.from_json(_object_in(answer))
    except ValueError as fault:
        messages += [
            {"role": "assistant", "content": answer or "(nothing)"},
            {"role": "user", "content": f"That cannot be used: {fault}. Answer again with the corrected JSON object alone."},
        ]
    try:
        return Request.from_json(_object_in(connection.answer(messages)))
    except LanguageModelError:
        raise
    except ValueError as fault:
        raise LanguageModelError(f"{model} was asked twice and gave no usable answer: {fault}; try another model") from fault


def _object_in(answer: str) -> str:
    """The JSON object in an answer, without reasoning before it and code fences around it.

    Raises:
        ValueError: the answer is far too long, or nested too deeply.
    """
    if len(answer) > LONGEST:
        raise ValueError(f"an answer has at most {LONGEST:,} characters, found {len(answer):,}")
    answer = re.sub(r"<think>.*?</think>", "", answer, flags=re.DOTALL)
    for brace in re.finditer(r"\{", answer):
        try:
            _, end = json.JSONDecoder().raw_decode(answer, brace.start())
        except ValueError:
            continue
        except RecursionError as error:
            raise ValueError("a request is one JSON object without others in it, found some nested very deeply") from error
        return answer[brace.start() : end]
    return answer.strip()


def _stored(path: Path) -> Request:
    try:
        return Request.from_json(json.dumps(json.loads(path.read_text("utf-8"))["request"]))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise LanguageModelError(f"the stored answer {path} is damaged ({line_of(error)}); correct or delete it") from error
