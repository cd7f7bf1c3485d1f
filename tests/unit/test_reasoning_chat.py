# SPDX-License-Identifier: MIT
"""A chat endpoint on this machine that misbehaves in every way: what is said of it, and that the key stays secret."""

import base64
import datetime
import gzip
import json
import socket
import ssl
import threading
import time
import traceback
from email.utils import formatdate

import pytest
from physgen.sim.errors import Cancelled, InputError
from physgen.sim.reconstruct.reasoning.chat_client import ChatRequest, complete_chat
from physgen.sim.reconstruct.reasoning.http_post import MAX_ANSWER_BYTES

from .chat_server import LINES, Server, completion, send

KEY = "sk-secret-0123456789abcdef"
JPEG = b"\xff\xd8 not really a picture \xff\xd9"


@pytest.fixture(autouse=True)
def key(monkeypatch):
    monkeypatch.setenv("PHYSGEN_API_KEY", KEY)


def request(url, **values):
    return ChatRequest(
        **{"url": url, "model": "m", "consent": True, "timeout_s": 5, "retries": 0, "backoff_s": 0.01, **values}
    )


def ask(url, cancelled=lambda: False, **values):
    notices = []
    return complete_chat(request(url, **values), "what is it?", JPEG, notices.append, cancelled), notices


def refusal(url, **values):
    """The message of the error, after a look for the key in all that could be shown of it."""
    notices = []
    with pytest.raises(InputError) as caught:
        complete_chat(request(url, **values), "what is it?", JPEG, notices.append)
    shown = [str(caught.value), repr(caught.value), *notices, *traceback.format_exception(caught.value)]
    link = caught.value
    while link is not None:
        shown += [repr(link), repr(vars(link))]
        link = link.__cause__ or link.__context__
    assert not any(KEY.casefold() in text.casefold() for text in shown)
    assert "\n" not in str(caught.value) and "\x1b" not in str(caught.value)
    return str(caught.value)


def test_request_is_a_chat_message_with_the_picture():
    with Server(lambda h, n: send(h, completion())) as server:
        text, notices = ask(server.url, model="a model")
    ((path, headers, body),) = server.received
    assert text == LINES and not notices
    assert path == "/v1/chat/completions" and headers["Authorization"] == f"Bearer {KEY}"
    sent = json.loads(body)
    assert sent["model"] == "a model" and sent["stream"] is False and KEY.encode() not in body
    words, picture = sent["messages"][0]["content"]
    assert words == {"type": "text", "text": "what is it?"}
    prefix, data = picture["image_url"]["url"].split(",")
    assert prefix == "data:image/jpeg;base64" and base64.b64decode(data) == JPEG


@pytest.mark.parametrize(
    ("given", "path"),
    [
        ("", "/v1/chat/completions"),
        ("/v1", "/v1/chat/completions"),
        ("/api/v2/", "/api/v2/chat/completions"),
        ("/x/chat/completions?version=1", "/x/chat/completions?version=1"),
    ],
)
def test_the_url_may_be_given_in_part(given, path):
    with Server(lambda h, n: send(h, completion())) as server:
        ask(server.url + given)
    assert server.received[0][0] == path


def test_without_a_key_none_is_sent(monkeypatch):
    monkeypatch.delenv("PHYSGEN_API_KEY")
    with Server(lambda h, n: send(h, completion())) as server:
        assert ask(server.url)[0] == LINES
    assert "Authorization" not in server.received[0][1]


@pytest.mark.parametrize("consent", [False, None, 0, "yes", 1])
def test_nothing_is_sent_without_consent(consent):
    with pytest.raises(InputError, match="consent"):
        ChatRequest(url="http://127.0.0.1:9", model="m", consent=consent)
    with pytest.raises(InputError, match="consent"):
        ChatRequest(url="http://127.0.0.1:9", model="m")


@pytest.mark.parametrize(
    ("values", "what"),
    [
        ({"url": "ftp://host/v1"}, "http and https"),
        ({"url": "file:///etc/passwd"}, "http and https"),
        ({"url": "host/v1"}, "http and https"),
        ({"url": "https://"}, "no host"),
        ({"url": "https://[1:2"}, "not a URL"),
        ({"url": "https://host:99999/"}, "not a URL"),
        ({"url": f"https://me:{KEY}@host/v1"}, "user name or password"),
        ({"url": "https://host/a\r\nX: y"}, "odd characters"),
        ({"model": ""}, "model"),
        ({"model": "a\nb"}, "model"),
        ({"key_variable": KEY}, "key_variable"),
        ({"timeout_s": 0}, "timeout_s"),
        ({"timeout_s": float("nan")}, "timeout_s"),
        ({"retries": -1}, "retries"),
        ({"backoff_s": float("inf")}, "backoff_s"),
    ],
)
def test_a_request_that_cannot_be_is_refused(values, what):
    with pytest.raises(InputError, match=what) as caught:
        request(**{"url": "http://host", **values})
    link = caught.value
    while link is not None:
        assert KEY not in repr(link)
        link = link.__cause__ or link.__context__


def test_the_key_is_in_no_repr_and_a_bad_one_is_not_repeated(monkeypatch):
    assert KEY not in repr(request("http://host"))
    monkeypatch.setenv("PHYSGEN_API_KEY", f"{KEY}\r\nX-Other: 1")
    assert "characters that a key cannot have" in refusal("http://127.0.0.1:9")
    assert "no such variable" in refusal("http://127.0.0.1:9", key_variable="PHYSGEN_NOT_SET")


def test_an_endpoint_that_is_down():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    message = refusal(f"http://127.0.0.1:{port}", retries=2)
    assert "could not be reached" in message and "tried 3 times" in message and f"127.0.0.1:{port}" in message


def test_a_slow_endpoint_is_given_up_once_even_where_it_drips():
    asked = threading.Event()

    def drip(handler, n):
        handler.send_response(200)
        handler.end_headers()
        while not asked.wait(0.02):
            handler.wfile.write(b" ")
            handler.wfile.flush()

    with Server(drip) as server:
        message = refusal(server.url, timeout_s=0.2, retries=3)
        asked.set()
    # A second attempt would send the photo, and the bill, again.
    assert "within 0.2 s" in message and len(server.received) == 1


def test_cancelling_does_not_wait_for_the_answer():
    release, seen = threading.Event(), threading.Event()

    def stall(handler, n):
        seen.set()
        release.wait(30)

    with Server(stall) as server:
        with pytest.raises(Cancelled):
            ask(server.url, cancelled=seen.is_set, timeout_s=3600)
        release.set()


def test_cancelling_ends_the_pause_between_attempts():
    with Server(lambda h, n: send(h, b"{}", 429, Retry_After="50")) as server, pytest.raises(Cancelled):
        ask(server.url, cancelled=lambda: len(server.received) > 0, retries=1)


def test_a_busy_endpoint_is_asked_again_when_it_says():
    with Server(lambda h, n: send(h, b"{}", 429, Retry_After="0.05") if n == 0 else send(h, completion())) as server:
        text, notices = ask(server.url, retries=1, backoff_s=60)
    assert text == LINES and len(server.received) == 2
    assert len(notices) == 1 and "429" in notices[0] and "0.05 s" in notices[0]


@pytest.mark.parametrize("after", ["3600", formatdate(time.time() + 7200, usegmt=True)], ids=["seconds", "date"])
def test_an_endpoint_that_is_busy_for_long_is_not_waited_for(after):
    with Server(lambda h, n: send(h, b"{}", 429, Retry_After=after)) as server:
        assert "429" in refusal(server.url, retries=3)
    assert len(server.received) == 1


@pytest.mark.parametrize("after", ["", "soon", "-5", "1e9", formatdate(0, usegmt=True)])
def test_an_odd_retry_after_is_as_none(after):
    with Server(lambda h, n: send(h, b"{}", 503, Retry_After=after) if n == 0 else send(h, completion())) as server:
        assert ask(server.url, retries=1)[0] == LINES


def test_a_failing_endpoint_is_tried_as_often_as_said():
    def fail(handler, n):
        send(handler, json.dumps({"error": {"message": f"broken \x1b[31m\nfor {KEY.upper()}"}}).encode(), 500)

    with Server(fail) as server:
        message = refusal(server.url, retries=2)
    assert len(server.received) == 3 and "tried 3 times" in message and "broken" in message and "***" in message


@pytest.mark.parametrize("status", [401, 403])
def test_a_refused_key_is_not_shown_even_if_the_server_does(status):
    body = json.dumps({"error": {"message": f"Incorrect API key provided: {KEY}, or {KEY[:7]}..{KEY[-4:]}"}}).encode()
    with Server(lambda h, n: send(h, body, status)) as server:
        message = refusal(server.url, retries=3)
    assert str(status) in message and KEY[:7] not in message and KEY[-4:] not in message and len(server.received) == 1


def test_a_key_in_a_broken_answer_or_its_status_line_is_not_shown():
    with Server(lambda h, n: send(h, f"<html>{KEY}</html>".encode())) as server:
        assert "web page" in refusal(server.url)
    with Server(lambda h, n: h.wfile.write(f"{KEY} hello\r\n\r\n".encode())) as server:
        assert "HTTP" in refusal(server.url)
    with Server(lambda h, n: send(h, completion(f"your key is {KEY}"))) as server:
        assert ask(server.url)[0] == "your key is ***"
    with Server(lambda h, n: send(h, b"", 307, Location=f"http://{KEY}.example/")) as server:
        assert "redirects" in refusal(server.url)


@pytest.mark.parametrize(
    ("body", "what"),
    [
        (b"", "nothing"),
        (b"   ", "nothing"),
        (b"<!DOCTYPE html><p>hello", "web page"),
        (b"certainly!", "not JSON"),
        (b'{"choices": [', "not JSON"),
        (b"[" * 100_000, "not JSON"),
        (b"\xff\xfe\x00\x01", "not JSON"),
        (b"[]", "no text"),
        (b"null", "not JSON"),
        (b"3", "no text"),
        (b'{"choices": []}', "no text"),
        (b'{"choices": {"0": 1}}', "no text"),
        (b'{"choices": [{"message": "hi"}]}', "no text"),
        (b'{"choices": [{"message": {"content": 5}, "finish_reason": "content_filter"}]}', "content_filter"),
        (completion(""), "no text"),
        (completion([{"type": "image"}, 3, None]), "no text"),
        (completion(None, refusal="I will not.\nEver."), "refuses: I will not. Ever."),
        (completion(None, tool_calls=[{"id": "1"}]), "tool"),
        (b'{"error": {"message": "model is\\u001b[31m asleep"}}', "asleep"),
        (b'{"error": true}', "error"),
    ],
)
def test_nonsense_is_said_to_be_nonsense(body, what):
    with Server(lambda h, n: send(h, body)) as server:
        assert what in refusal(server.url)


@pytest.mark.parametrize("status", [400, 404, 413, 422, 501])
def test_permanent_errors_are_not_retried(status):
    with Server(lambda h, n: send(h, b'{"detail": "no good"}', status)) as server:
        assert str(status) in refusal(server.url, retries=3)
    assert len(server.received) == 1


def test_an_answer_without_end_is_cut_short():
    def stream(handler, n):
        handler.send_response(200)
        handler.end_headers()
        while True:
            handler.wfile.write(b"a" * 2**18)

    with Server(stream) as server:
        assert "MiB" in refusal(server.url)


def test_a_small_answer_that_unpacks_to_a_huge_one_is_cut_short():
    packed = gzip.compress(b" " * (20 * MAX_ANSWER_BYTES))
    with Server(lambda h, n: send(h, packed, Content_Encoding="gzip")) as server:
        assert "MiB" in refusal(server.url)


def test_an_answer_that_breaks_off_is_asked_for_again():
    def cut(handler, n):
        send(handler, completion()[: 40 if n == 0 else None], Content_Length=str(len(completion())))

    with Server(cut) as server:
        text, notices = ask(server.url, retries=1)
    assert text == LINES and "middle" in notices[0]
    with Server(lambda h, n: h.wfile.write(b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nff\r\n{")) as server:
        assert "broke" in refusal(server.url)
    with Server(lambda h, n: None) as server:
        assert "hung up" in refusal(server.url)


def test_chunked_packed_mislabelled_and_listed_answers_are_read():
    def chunked(handler, n):
        handler.send_response(200)
        handler.send_header("Transfer-Encoding", "chunked")
        handler.end_headers()
        for byte in completion():
            handler.wfile.write(b"1\r\n" + bytes([byte]) + b"\r\n")
        handler.wfile.write(b"0\r\n\r\n")

    def packed(handler, n):
        send(handler, gzip.compress(completion()), Content_Encoding="gzip")

    def mislabelled(handler, n):
        send(handler, completion(), Content_Type="text/html")

    def parts(handler, n):
        halves = [{"type": "reasoning", "text": None}, {"type": "text", "text": LINES[:40]}, {"text": LINES[40:]}]
        send(handler, completion(halves))

    for behave in (chunked, packed, mislabelled, parts):
        with Server(behave) as server:
            assert ask(server.url)[0].replace("\n", "") == LINES.replace("\n", "")
    with Server(lambda h, n: send(h, completion(), Content_Encoding="br")) as server:
        assert "Content-Encoding" in refusal(server.url)
    with Server(lambda h, n: send(h, b"garbage", Content_Encoding="gzip")) as server:
        refusal(server.url)


def test_an_answer_that_reached_the_models_limit_is_used_and_said():
    body = json.dumps({"choices": [{"finish_reason": "length", "message": {"content": LINES}}]}).encode()
    with Server(lambda h, n: send(h, body)) as server:
        text, notices = ask(server.url)
    assert text == LINES and "cut off" in notices[0]


def test_the_photo_never_follows_a_redirect_to_another_host():
    with Server(lambda h, n: send(h, completion())) as other:
        for place in (f"{other.url}/v1/chat/completions", "//example.invalid/x", "http://[", "ftp://127.0.0.1/"):
            with Server(lambda h, n, place=place: send(h, b"", 307, Location=place)) as server:
                assert "redirects" in refusal(server.url, retries=2)
            assert len(server.received) == 1
        with Server(lambda h, n: send(h, b"", 302, Location="/elsewhere")) as server:
            # 302 would turn the question into a GET without the picture.
            assert "302" in refusal(server.url)
        assert not other.received


def test_redirects_within_the_host_are_followed_and_end():
    def once(handler, n):
        send(handler, b"", 308, Location="/new/chat/completions?a=b") if n == 0 else send(handler, completion())

    with Server(once) as server:
        assert ask(server.url)[0] == LINES
    assert server.received[1][0] == "/new/chat/completions?a=b" and server.received[1][2] == server.received[0][2]
    with Server(lambda h, n: send(h, b"", 307, Location="/again")) as server:
        assert "redirects" in refusal(server.url, retries=5)
    assert len(server.received) == 4


def test_a_model_that_takes_no_temperature_is_asked_without():
    def picky(handler, n):
        if n == 0:
            send(handler, b'{"error": {"message": "Unsupported value: temperature"}}', 400)
        else:
            send(handler, completion())

    with Server(picky) as server:
        assert ask(server.url)[0] == LINES
    assert [("temperature" in json.loads(body)) for _, _, body in server.received] == [True, False]
    with Server(lambda h, n: send(h, b'{"error": "temperature"}', 400)) as server:
        assert "400" in refusal(server.url)
    assert len(server.received) == 2


def test_proxies_of_the_environment_are_not_used(monkeypatch):
    with (
        Server(lambda h, n: send(h, completion())) as server,
        Server(lambda h, n: send(h, completion("proxied"))) as proxy,
    ):
        for name in ("http_proxy", "HTTP_PROXY", "all_proxy"):
            monkeypatch.setenv(name, proxy.url)
        assert ask(server.url)[0] == LINES and not proxy.received


def test_no_thread_or_socket_stays_behind():
    before = threading.active_count()
    with Server(lambda h, n: send(h, completion())) as server:
        ask(server.url)
        deadline = time.monotonic() + 10
        while any(t.name == "physgen-chat" for t in threading.enumerate()) and time.monotonic() < deadline:
            time.sleep(0.01)
    assert not any(t.name == "physgen-chat" for t in threading.enumerate())
    assert threading.active_count() <= before + 1


def test_an_unencrypted_way_over_the_network_is_said():
    notices = []
    with pytest.raises(Cancelled):
        complete_chat(request("http://host.invalid"), "?", JPEG, notices.append, lambda: True)
    assert "unencrypted" in notices[0] and "photo and key" in notices[0]


def test_certificates_are_verified(tmp_path, monkeypatch):
    x509 = pytest.importorskip("cryptography.x509")
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    private = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "localhost")])
    now = datetime.datetime.now(datetime.UTC)
    certificate = (
        x509.CertificateBuilder(name, name, private.public_key(), x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
        .sign(private, hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    (tmp_path / "certificate.pem").write_bytes(certificate.public_bytes(pem))
    (tmp_path / "both.pem").write_bytes(
        private.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
        + certificate.public_bytes(pem)
    )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(tmp_path / "both.pem")
    release = threading.Event()

    def behave(handler, n):
        if n == 0:
            send(handler, completion())
        else:
            release.wait(30)

    with Server(behave, context) as server:
        url = server.url.replace("http://127.0.0.1", "https://localhost")
        assert "certificate" in refusal(url, retries=3)
        assert not server.received
        monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "certificate.pem"))
        assert ask(url)[0] == LINES
        # Of another name than the certificate's.
        assert "certificate" in refusal(url.replace("localhost", "127.0.0.1"))
        assert "within 0.2 s" in refusal(url, timeout_s=0.2)
        release.set()
