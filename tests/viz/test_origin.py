"""The live viewer accepts connections from local pages and programs, and refuses web pages of other origins."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator

import pytest

viser = pytest.importorskip("viser", reason="the live viewer needs the extra `report`")

from websockets.exceptions import InvalidStatus  # noqa: E402
from websockets.sync.client import connect  # noqa: E402
from websockets.typing import Subprotocol  # noqa: E402

from ballu_mjx.viz.viser_scene import LocalServer, serve  # noqa: E402


@pytest.fixture(scope="module")
def server() -> Iterator[LocalServer]:
    server = serve(18080)
    yield server
    server.stop()


def talk(server: LocalServer, origin: str | None) -> bytes | str:
    """Return the first message from the server to a page of an origin. None for a client that is not a browser."""
    protocol = Subprotocol(f"viser-v{importlib.metadata.version('viser')}")
    headers = {} if origin is None else {"Origin": origin}
    with connect(
        f"ws://127.0.0.1:{server.get_port()}/", additional_headers=headers, subprotocols=[protocol], open_timeout=5
    ) as socket:
        return socket.recv(timeout=5)


@pytest.mark.parametrize("origin", ["http://127.0.0.1:{port}", "http://localhost:{port}", "http://localhost:9", None])
def test_its_own_page_and_local_programs_can_connect(server: LocalServer, origin: str | None):
    assert talk(server, None if origin is None else origin.format(port=server.get_port()))


@pytest.mark.parametrize(
    "origin",
    ["http://example.org", "https://127.0.0.1:{port}", "http://127.0.0.2:{port}", "file://", "null",
     "http://127.0.0.1:{port}.example.org", "http://example.org:{port}"],
)  # fmt: skip
def test_pages_of_other_origins_are_refused(server: LocalServer, origin: str):
    with pytest.raises(InvalidStatus, match="403"):
        talk(server, origin.format(port=server.get_port()))


def test_a_port_chosen_by_the_system_also_refuses_other_origins():
    server = serve(0)
    try:
        assert talk(server, f"http://127.0.0.1:{server.get_port()}")
        with pytest.raises(InvalidStatus, match="403"):
            talk(server, "http://example.org")
    finally:
        server.stop()
