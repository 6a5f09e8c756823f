"""A connection to a language model of any provider that any-llm knows, or of a server that speaks one of their protocols.

Keys and addresses come from the environment: OPENAI_API_KEY and OPENAI_BASE_URL, ANTHROPIC_API_KEY and ANTHROPIC_BASE_URL.
"""

from __future__ import annotations

import re
import sys
import threading
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

RETRIES = 1  # after no answer, or after an error that may pass
MODEL = re.compile(r"[a-z0-9_]+:\S+")
HOW_TO_NAME = (
    "PROVIDER:NAME such as openai:NAME, anthropic:NAME, or vllm:NAME for a server of your own that speaks OpenAI's protocol "
    "(then its address too, http://127.0.0.1:8000/v1)"
)


class LanguageModelError(ValueError):
    """The language model gave no usable answer; the message says why and what to do."""


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
            raise LanguageModelError(f"{model} cannot be asked: {line_of(error)}") from error
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
            completion = self._completed(messages)
        except AnyLLMError as error:
            raise LanguageModelError(self._why(error)) from error
        choices = completion.choices
        return (choices[0].message.content or "") if choices else ""

    def _completed(self, messages: list[dict[str, str]]) -> Any:
        """The client's answer within the time of all tries.

        The client bounds the wait for each piece of an answer, so that a server that sends byte after byte would be waited for
        without end. The call is left to a thread, which nobody waits for once its time is over.
        """
        found: list[Any] = []

        def call() -> None:
            try:
                found.append(self.client.completion(model=self.name, messages=messages, timeout=self.timeout))
            except BaseException as error:
                found.append(error)

        thread = threading.Thread(target=call, daemon=True)
        thread.start()
        # A second more than the client's own bound, whose error says more.
        thread.join((RETRIES + 1) * self.timeout + 1.0)
        if not found:
            raise LanguageModelError(self._late())
        if isinstance(found[0], BaseException):
            raise found[0]
        return found[0]

    def _late(self) -> str:
        return f"{self.model} gave no answer within {self.timeout:g} s, asked {RETRIES + 1} times; allow it more time"

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
            return f"{self.model} answered with an error (HTTP {status}: {line_of(error)}); {advice}"
        causes = list(_causes(error))
        if any("timeout" in type(cause).__name__.lower() for cause in causes):
            return self._late()
        if any("connect" in type(cause).__name__.lower() for cause in causes):
            return f"{self._place} cannot be reached ({line_of(causes[-1])}); is there a network, and is the address right?"
        return f"{self._place} did not speak the protocol of its provider ({line_of(error)}); is that the address of its API?"

    @property
    def _place(self) -> str:
        """Provider and host of the server, without a password that may be part of the address."""
        address = urlsplit(str(getattr(self.client.client, "base_url", "") or self.base_url or ""))
        return f"{self.model.partition(':')[0]} at {address.hostname}{f':{address.port}' if address.port else ''}"


def _causes(error: BaseException | None) -> Any:
    while error is not None:
        yield error
        error = getattr(error, "original_exception", None) or error.__cause__ or error.__context__


def line_of(error: BaseException) -> str:
    """What an error says, on one line of at most 200 characters."""
    words = " ".join(str(getattr(error, "message", error)).split()) or type(error).__name__
    return words if len(words) <= 200 else f"{words[:197]}..."
