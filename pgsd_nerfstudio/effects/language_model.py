"""Ask a language model for the numbers of a request (paper, appearance initialization), and store its answer.

The model is that of any provider that any-llm knows, or of any server that speaks the protocol of OpenAI or Anthropic. Keys and
addresses come from the environment (OPENAI_API_KEY and OPENAI_BASE_URL, ANTHROPIC_API_KEY and ANTHROPIC_BASE_URL, ...) and are
never stored. Not every server knows structured output, so the instructions hold the schema of a request, and
Request.from_json checks the answer. If the model does not answer, the reader answers instead only if the caller allows it.
"""

from __future__ import annotations

import json
import re
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from pgsd_nerfstudio.effects.reader import NO_WEATHER, check_length, read
from pgsd_nerfstudio.effects.request import SCHEMA, Request
from pgsd_nerfstudio.storage import atomic_write, content_key
from pgsd_nerfstudio.storage import cache_dir as shared_cache

RETRIES = 1  # after no answer, or after an error that may pass
MODEL = re.compile(r"[a-z0-9_]+:\S+")
HOW_TO_NAME = (
    "PROVIDER:NAME such as openai:NAME, anthropic:NAME, or vllm:NAME for a server of your own that speaks OpenAI's protocol "
    "(then its address too, http://127.0.0.1:8000/v1)"
)
INSTRUCTIONS = f"""\
You turn a short description of weather, or of anything else that fills the air, into numbers for a simulation of particles in a
3D Gaussian Splatting scene: how they look, in the air and landed, and how they move. The numbers change one of four base
effects; choose the one that moves most like what is described, and numbers that a physicist and a painter would accept.
Leave at its default whatever the description says nothing about. If nothing in it could be in the air, base is null.
Answer with one JSON object and nothing else. It must satisfy this JSON schema:
{json.dumps(SCHEMA)}"""


class LanguageModelError(ValueError):
    """The language model gave no usable answer; the message says why and what to do."""


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


def check_model(model: str, base_url: str | None) -> None:
    """Check the name of a model and the address of its server, without asking it.

    Args:
        model: PROVIDER:NAME.
        base_url: address of the server; None: the provider's own or the one in the environment.

    Raises:
        LanguageModelError: the name is not PROVIDER:NAME, or the address does not begin with http:// or https:// and a host.
    """
    if not MODEL.fullmatch(model):
        raise LanguageModelError(f"a language model must be named {HOW_TO_NAME}, found {model!r}")
    if base_url is not None and not re.match(r"https?://[^/]", base_url):
        raise LanguageModelError(f"the address of {model} must begin with http:// or https:// and a host, found {base_url!r}")


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
    """The JSON object in an answer, without reasoning before it and code fences around it."""
    answer = re.sub(r"<think>.*?</think>", "", answer, flags=re.DOTALL)
    for brace in re.finditer(r"\{", answer):
        try:
            _, end = json.JSONDecoder().raw_decode(answer, brace.start())
        except ValueError:
            continue
        return answer[brace.start() : end]
    return answer.strip()


@dataclass(frozen=True)
class Connection:
    """A provider's client for one model, with errors as single sentences."""

    client: Any
    model: str
    name: str
    base_url: str | None
    timeout: float

    @staticmethod
    def open(model: str, base_url: str | None, timeout: float) -> Connection:
        """Make the client of a model; arguments as for `ask`.

        Raises:
            LanguageModelError: the name or the address cannot be used, or a library or a key is missing.
        """
        check_model(model, base_url)
        provider, _, name = model.partition(":")
        try:
            from any_llm import AnyLLM
            from any_llm.exceptions import AnyLLMError, MissingApiKeyError, UnsupportedProviderError
        except ImportError as error:
            version = "" if sys.version_info >= (3, 11) else ", on Python 3.11 or later"
            raise LanguageModelError(
                f"asking {model} needs the library any-llm{version}: pip install 'pgsd-nerfstudio[llm]'"
            ) from error
        try:
            client = AnyLLM.create(provider, api_base=base_url, unified_exceptions=True, max_retries=RETRIES)
        except UnsupportedProviderError as error:
            raise LanguageModelError(f"there is no provider {provider!r}; name the model {HOW_TO_NAME}") from error
        except MissingApiKeyError as error:
            key = f"a key in the environment: export {error.env_var_name}=..."
            keyless = "; a server of your own that wants none is asked as vllm:NAME" if base_url else ""
            raise LanguageModelError(f"asking {model} needs {key}{keyless}") from error
        except ImportError as error:
            raise LanguageModelError(f"asking {model} needs one more library: pip install 'any-llm-sdk[{provider}]'") from error
        except AnyLLMError as error:
            raise LanguageModelError(f"{model} cannot be asked: {_line(error)}") from error
        return Connection(client, model, name, base_url, timeout)

    def answer(self, messages: list[dict[str, str]]) -> str:
        """The model's next message; empty if it has no text.

        Args:
            messages: the conversation so far, each with a "role" and a "content".

        Raises:
            LanguageModelError: the model cannot be reached, does not answer in time, or answers with an error.
        """
        from any_llm.exceptions import AnyLLMError

        try:
            completion = self.client.completion(model=self.name, messages=messages, timeout=self.timeout)
        except AnyLLMError as error:
            raise LanguageModelError(self._why(error)) from error
        choices = completion.choices
        return (choices[0].message.content or "") if choices else ""

    def _why(self, error: Any) -> str:
        status = error.status_code
        if status in (401, 403):
            # The server's own words may repeat a part of the key.
            return f"{self.model} refused the key in {self.client.ENV_API_KEY_NAME} (HTTP {status}); check it"
        if status == 404:
            return f"{self._place} knows no model {self.name!r}, or is not the address of its API (HTTP 404)"
        if status == 429:
            return f"{self.model} has too many requests or no credit left (HTTP 429); wait, or ask another model"
        if status is not None and status >= 400:
            advice = "try again later or ask another model" if status >= 500 else "ask another model"
            return f"{self.model} answered with an error (HTTP {status}: {_line(error)}); {advice}"
        causes = list(_causes(error))
        if any("timeout" in type(cause).__name__.lower() for cause in causes):
            return f"{self.model} gave no answer within {self.timeout:g} s, asked {RETRIES + 1} times; allow it more time"
        if any("connect" in type(cause).__name__.lower() for cause in causes):
            return f"{self._place} cannot be reached ({_line(causes[-1])}); is there a network, and is the address right?"
        return f"{self._place} did not speak the protocol of its provider ({_line(error)}); is that the address of its API?"

    @property
    def _place(self) -> str:
        """Provider and host of the server, without a password that may be part of the address."""
        address = urlsplit(str(getattr(self.client.client, "base_url", "") or self.base_url or ""))
        return f"{self.model.partition(':')[0]} at {address.hostname}{f':{address.port}' if address.port else ''}"


def _causes(error: BaseException | None) -> Any:
    while error is not None:
        yield error
        error = getattr(error, "original_exception", None) or error.__cause__ or error.__context__


def _line(error: BaseException) -> str:
    words = " ".join(str(getattr(error, "message", error)).split()) or type(error).__name__
    return words if len(words) <= 200 else f"{words[:197]}..."


def _stored(path: Path) -> Request:
    try:
        return Request.from_json(json.dumps(json.loads(path.read_text("utf-8"))["request"]))
    except (ValueError, KeyError, TypeError) as error:
        raise LanguageModelError(f"the stored answer {path} is damaged ({_line(error)}); correct or delete it") from error
