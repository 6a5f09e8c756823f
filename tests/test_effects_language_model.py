"""A language model is asked through real HTTP: one local server speaks as OpenAI does, one as Anthropic does.

What the servers are sent is judged by the two protocols: path, key header, and where instructions and words of the user stand.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from pgsd_nerfstudio.effects.language_model import LanguageModelError, ask, request_for
from pgsd_nerfstudio.effects.reader import read
from pgsd_nerfstudio.effects.request import Request

needs_library = pytest.mark.skipif(find_spec("any_llm") is None, reason="needs pip install -e '.[llm]'")

GOOD = {"base": "snowfall", "rgb": [0.5, 0.0, 0.5], "glitter": 0.3, "prompt": "Purple snow falls in {scene}"}
REQUEST = Request(base="snowfall", rgb=(0.5, 0.0, 0.5), glitter=0.3, prompt="Purple snow falls in {scene}")
KEY = "sk-secret-0123456789"


@dataclass
class Server:
    """Answers in turn what it was told to, the last over and over, and remembers what it was asked."""

    protocol: str
    turns: list[str | int | bytes | bytearray | None]
    """An answer of the model, an HTTP status, raw bytes, None: silence, or a bytearray: a byte of it every 50 ms."""
    asked: list[dict[str, Any]] = field(default_factory=list)
    url: str = ""
    done: threading.Event = field(default_factory=threading.Event)

    @property
    def model(self) -> str:
        return f"{self.protocol}:test-model"

    def body(self, answer: str) -> bytes:
        if self.protocol == "anthropic":
            told: dict[str, Any] = {"id": "msg_1", "type": "message", "role": "assistant", "model": "test-model"}
            told |= {"content": [{"type": "text", "text": answer}], "stop_reason": "end_turn", "stop_sequence": None}
            told["usage"] = {"input_tokens": 1, "output_tokens": 1}
        else:
            told = {"id": "chatcmpl-1", "object": "chat.completion", "created": 1, "model": "test-model"}
            told["choices"] = [{"index": 0, "message": {"role": "assistant", "content": answer}, "finish_reason": "stop"}]
            told["usage"] = {"prompt_tokens": 1, "completion_tokens": 1, "total_tokens": 2}
        return json.dumps(told).encode()

    def heard(self, at: int) -> tuple[str, list[tuple[str, str]]]:
        """Instructions and conversation of one request, from where the protocol puts them."""
        body = self.asked[at]["body"]

        def text(content: Any) -> str:
            return content if isinstance(content, str) else "".join(part["text"] for part in content)

        spoken = [(message["role"], text(message["content"])) for message in body["messages"]]
        if self.protocol == "anthropic":
            return text(body["system"]), spoken
        assert spoken[0][0] == "system"
        return spoken[0][1], spoken[1:]


@contextmanager
def serving(protocol: str, *turns: str | int | bytes | bytearray | None) -> Iterator[Server]:
    told = Server(protocol, list(turns))

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            body = json.loads(self.rfile.read(int(self.headers["content-length"])))
            told.asked.append({"path": self.path, "headers": {k.lower(): v for k, v in self.headers.items()}, "body": body})
            turn = told.turns[0] if len(told.turns) == 1 else told.turns.pop(0)
            if turn is None:
                told.done.wait(30)
                self.close_connection = True
                return
            status = turn if isinstance(turn, int) else 200
            sent = b'{"error": {"message": "out of order", "type": "x"}}' if isinstance(turn, int) else turn
            sent = told.body(sent) if isinstance(sent, str) else sent
            self.send_response(status)
            self.send_header("content-type", "application/json")
            self.send_header("retry-after-ms", "1")
            self.send_header("content-length", str(len(sent)))
            self.end_headers()
            if not isinstance(sent, bytearray):
                self.wfile.write(sent)
                return
            for byte in sent:
                if told.done.wait(0.05):
                    return
                self.wfile.write(bytes([byte]))
                self.wfile.flush()

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    told.url = f"http://127.0.0.1:{server.server_port}" + ("" if protocol == "anthropic" else "/v1")
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield told
    finally:
        told.done.set()
        server.shutdown()
        server.server_close()
        thread.join()


@pytest.fixture(autouse=True)
def keys(monkeypatch):
    for name in ("OPENAI_BASE_URL", "ANTHROPIC_BASE_URL", "HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    monkeypatch.setenv("ANTHROPIC_API_KEY", KEY)


@pytest.fixture(params=["openai", "anthropic"])
def protocol(request) -> str:
    return request.param


def asked(server: Server, folder: Path, prompt: str = "purple snow", timeout: float = 10.0) -> Request:
    return ask(prompt, model=server.model, base_url=server.url, cache_dir=folder, timeout=timeout)


@needs_library
def test_a_good_answer_is_the_request_and_the_question_follows_the_protocol(protocol, tmp_path):
    with serving(protocol, json.dumps(GOOD)) as server:
        assert asked(server, tmp_path) == REQUEST
    request = server.asked[0]
    assert request["body"]["model"] == "test-model"
    if protocol == "anthropic":
        assert request["path"] == "/v1/messages" and request["headers"]["x-api-key"] == KEY
        assert request["body"]["max_tokens"] >= 1024
    else:
        assert request["path"] == "/v1/chat/completions" and request["headers"]["authorization"] == f"Bearer {KEY}"
    instructions, spoken = server.heard(0)
    assert spoken == [("user", "purple snow")]
    # The model is told every field, its limits and its meaning.
    for word in ("fall_speed", "landed_rgb", "sandstorm", '"maximum": 5', "{scene}", "JSON"):
        assert word in instructions


@needs_library
@pytest.mark.parametrize(
    "before", ["", "  ", "```json\n", "With {scene} in it:\n", "<think>or {'base': 'fog'}, or {}?</think>\n\n"]
)
@pytest.mark.parametrize("after", ["", "\n```", "\nEnjoy {scene}!"])
def test_what_models_put_around_their_answer_does_no_harm(before, after, tmp_path):
    with serving("openai", before + json.dumps(GOOD) + after) as server:
        assert asked(server, tmp_path) == REQUEST
    assert len(server.asked) == 1


@needs_library
@pytest.mark.parametrize(
    ("nonsense", "fault"),
    [
        ("I cannot do that.", 'a request must be one JSON object, found "I cannot do that."'),
        ("", "a request must be one JSON object"),
        (json.dumps(GOOD)[:-9], "a request must be one JSON object"),
        (json.dumps(GOOD | {"size": 50}), "size must be a number in 0.2-5, found 50"),
    ],
)
def test_after_nonsense_the_model_is_told_the_fault_and_asked_once_more(protocol, nonsense, fault, tmp_path):
    with serving(protocol, nonsense, json.dumps(GOOD)) as server:
        assert asked(server, tmp_path) == REQUEST
    assert len(server.asked) == 2
    _, spoken = server.heard(1)
    assert [role for role, _ in spoken] == ["user", "assistant", "user"]
    assert spoken[1][1] == (nonsense or "(nothing)")
    assert fault in spoken[2][1]


@needs_library
def test_nonsense_twice_is_an_error_that_says_what_was_wrong_and_leaves_nothing_behind(protocol, tmp_path):
    sentence = r"asked twice and gave no usable answer: size must be a number in 0.2-5, found 50"
    with serving(protocol, json.dumps(GOOD | {"size": 50})) as server, pytest.raises(LanguageModelError, match=sentence):
        asked(server, tmp_path)
    assert len(server.asked) == 2
    assert list(tmp_path.iterdir()) == []


@needs_library
@pytest.mark.parametrize(
    ("status", "sentence", "tries"),
    [
        (400, r":test-model answered with an error \(HTTP 400: .*out of order.*\); ask another model$", 1),
        (401, r":test-model refused the key in (OPENAI|ANTHROPIC)_API_KEY \(HTTP 401\); check it$", 1),
        (404, r"^(openai|anthropic) at 127.0.0.1:\d+ knows no model 'test-model', or is not the address of its API", 1),
        (429, r":test-model has too many requests or no credit left \(HTTP 429\)", 2),
        (500, r":test-model answered with an error \(HTTP 500: .*\); try again later or ask another model$", 2),
    ],
)
def test_a_refusal_is_one_sentence_that_says_what_to_do(protocol, status, sentence, tries, tmp_path):
    with serving(protocol, status) as server, pytest.raises(LanguageModelError, match=sentence) as caught:
        asked(server, tmp_path)
    assert len(server.asked) == tries  # what may pass is tried once more, what will not is not
    assert "\n" not in str(caught.value) and KEY not in str(caught.value) and KEY[:8] not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@needs_library
def test_an_error_that_passes_is_not_seen(protocol, tmp_path):
    with serving(protocol, 500, json.dumps(GOOD)) as server:
        assert asked(server, tmp_path) == REQUEST


@needs_library
def test_silence_ends_after_the_time_that_was_given(protocol, tmp_path):
    with serving(protocol, None) as server:
        with pytest.raises(
            LanguageModelError, match=r":test-model gave no answer within 0.2 s, asked 2 times; allow it more time"
        ):
            asked(server, tmp_path, timeout=0.2)
        assert len(server.asked) == 2


@needs_library
def test_a_server_that_sends_byte_after_byte_is_waited_for_no_longer(protocol, tmp_path):
    """Each byte comes in time, all of them would take a minute."""
    with serving(protocol, bytearray(b" " * 1200)) as server:
        began = time.monotonic()
        with pytest.raises(LanguageModelError, match=r"gave no answer within 0\.2 s"):
            asked(server, tmp_path, timeout=0.2)
        assert time.monotonic() - began < 5.0
    assert list(tmp_path.iterdir()) == []


@needs_library
@pytest.mark.parametrize(
    ("answer", "fault"),
    [('{"a":' * 50_000 + "1" + "}" * 50_000, "at most 100,000 characters"), ('{"a":' * 15_000 + "1" + "}" * 15_000, "deeply")],
)
def test_an_absurd_answer_is_refused_in_a_sentence(answer, fault, tmp_path):
    with serving("openai", answer) as server, pytest.raises(LanguageModelError, match=fault):
        asked(server, tmp_path)


@needs_library
@pytest.mark.parametrize("body", [b"hello", b"{}", b"[]", b"{"])
def test_a_server_of_another_kind_is_told_apart(protocol, body, tmp_path):
    sentence = r"did not speak the protocol .* address of its API\?"
    with serving(protocol, body) as server, pytest.raises(LanguageModelError, match=sentence):
        asked(server, tmp_path)


@needs_library
def test_where_nobody_listens_the_address_is_named_without_its_password(protocol, tmp_path):
    with serving(protocol) as server:
        pass
    address = server.url.replace("http://", "http://me:hidden@")
    with pytest.raises(
        LanguageModelError, match=r"^\w+ at 127.0.0.1:\d+ cannot be reached \(.*\); is there a network"
    ) as caught:
        ask("purple snow", model=server.model, base_url=address, cache_dir=tmp_path, timeout=5.0)
    assert "hidden" not in str(caught.value)


@needs_library
def test_without_a_key_its_name_is_said(protocol, tmp_path, monkeypatch):
    name = f"{protocol.upper()}_API_KEY"
    monkeypatch.delenv(name)
    sentence = rf"needs a key in the environment: export {name}=.*vllm:NAME"
    with serving(protocol, json.dumps(GOOD)) as server, pytest.raises(LanguageModelError, match=sentence):
        asked(server, tmp_path)
    assert server.asked == []


@needs_library
def test_a_server_of_ones_own_is_asked_without_a_key(tmp_path, monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY")
    with serving("openai", json.dumps(GOOD)) as server:
        assert ask("purple snow", model="vllm:llama", base_url=server.url, cache_dir=tmp_path) == REQUEST
    assert server.asked[0]["body"]["model"] == "llama"


@needs_library
def test_the_address_may_stand_in_the_environment(protocol, tmp_path, monkeypatch):
    with serving(protocol, json.dumps(GOOD)) as server:
        monkeypatch.setenv(f"{protocol.upper()}_BASE_URL", server.url)
        assert ask("purple snow", model=server.model, cache_dir=tmp_path) == REQUEST


@needs_library
@pytest.mark.parametrize(
    ("model", "url", "sentence"),
    [
        ("gpt", None, r"must be named PROVIDER:NAME such as .*, found 'gpt'"),
        ("openai/gpt", None, r"must be named PROVIDER:NAME"),
        ("nobody:gpt", None, r"there is no provider 'nobody'"),
        ("openai:gpt", "localhost:80", r"must begin with http:// or https:// and a host, found 'localhost:80'"),
    ],
)
def test_a_wrong_name_or_address_is_refused_before_anything_is_sent(model, url, sentence, tmp_path):
    with pytest.raises(LanguageModelError, match=sentence):
        ask("purple snow", model=model, base_url=url, cache_dir=tmp_path)


# Answers are stored.


@needs_library
def test_the_same_question_is_asked_once(tmp_path):
    with serving("openai", json.dumps(GOOD)) as server:
        assert asked(server, tmp_path) == asked(server, tmp_path, "  purple snow ") == REQUEST
        assert len(server.asked) == 1
        asked(server, tmp_path, "other snow")
        ask("purple snow", model="openai:other-model", base_url=server.url, cache_dir=tmp_path)
        assert len(server.asked) == 3
    stored = sorted(tmp_path.iterdir())
    assert len(stored) == 3 and all(path.name.startswith("request-") and path.suffix == ".json" for path in stored)
    told = [json.loads(path.read_text("utf-8")) for path in stored]
    assert {(each["prompt"], each["model"]) for each in told} == {
        ("purple snow", "openai:test-model"),
        ("other snow", "openai:test-model"),
        ("purple snow", "openai:other-model"),
    }
    assert all(KEY not in path.read_text("utf-8") for path in stored)


@needs_library
def test_a_kept_answer_may_be_corrected_by_hand_but_not_damaged(tmp_path):
    with serving("openai", json.dumps(GOOD)) as server:
        asked(server, tmp_path)
        (stored,) = tmp_path.iterdir()
        told = json.loads(stored.read_text("utf-8"))
        stored.write_text(json.dumps(told | {"request": told["request"] | {"size": 2.0}}), "utf-8")
        assert asked(server, tmp_path).size == 2.0
        for damaged in ("{", "{}", "[]", "[" * 100_000, json.dumps(told | {"request": told["request"] | {"size": 20}})):
            stored.write_text(damaged, "utf-8")
            with pytest.raises(
                LanguageModelError, match=r"stored answer .*request-\w+.json is damaged \(.*\); correct or delete it"
            ):
                asked(server, tmp_path)
        assert len(server.asked) == 1


@needs_library
def test_nothing_half_written_carries_the_final_name(tmp_path, monkeypatch):
    def full(self, *_):
        raise OSError("No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with serving("openai", json.dumps(GOOD)) as server, pytest.raises(OSError, match="No space left"):
        asked(server, tmp_path / "answers")
    assert list((tmp_path / "answers").iterdir()) == []


# Who answers.


def test_without_a_model_the_reader_answers():
    understanding = request_for("purple snow")
    assert (understanding.request, understanding.by) == (read("purple snow").request, "reader")
    assert understanding.remark == "understood snow = snowfall; purple = colour (0.50, 0.00, 0.50)"


@needs_library
def test_with_a_model_it_answers_and_is_named(tmp_path):
    with serving("openai", json.dumps(GOOD)) as server:
        understanding = request_for("purple snow", model=server.model, base_url=server.url, cache_dir=tmp_path)
    assert (understanding.request, understanding.by) == (REQUEST, "openai:test-model")
    said = "openai:test-model was asked what 'purple snow' means: snowfall, rgb (0.50, 0.00, 0.50), glitter 0.3"
    assert understanding.remark == said


@needs_library
def test_the_reader_steps_in_only_if_allowed_and_says_so(tmp_path):
    with serving("openai", 401) as server:
        server_options = {"model": server.model, "base_url": server.url, "cache_dir": tmp_path}
        with pytest.raises(LanguageModelError, match="refused the key"):
            request_for("purple snow", **server_options)
        understanding = request_for("purple snow", **server_options, reader_fallback=True)
    assert (understanding.request, understanding.by) == (read("purple snow").request, "reader")
    assert (
        understanding.remark.startswith("openai:test-model refused the key")
        and "The built-in reader answers instead: understood snow" in understanding.remark
    )


@needs_library
def test_a_model_may_say_that_a_text_names_no_weather(tmp_path):
    sentence = r"'a red truck' names nothing that could be in the air; .*openai:test-model"
    with serving("openai", json.dumps({"base": None, "prompt": "{scene}"})) as server:
        for _ in range(2):
            with pytest.raises(ValueError, match=sentence) as caught:
                asked(server, tmp_path, "a red truck")
            assert not isinstance(caught.value, LanguageModelError)  # it did answer: nobody has to step in
    assert len(server.asked) == 1


@pytest.mark.parametrize("prompt", ["", "snow " * 81])
def test_a_text_of_no_or_too_many_characters_is_sent_to_nobody(prompt, tmp_path):
    with pytest.raises(ValueError, match="must have 1-400 characters"):
        ask(prompt, model="openai:x", cache_dir=tmp_path)


def test_without_the_library_the_command_that_installs_it_is_said(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "any_llm", None)
    with pytest.raises(LanguageModelError, match=r"needs the library any-llm.*: pip install 'pgsd-nerfstudio\[llm\]'$"):
        ask("purple snow", model="openai:x", cache_dir=tmp_path)
