"""torchqm.cli.backends: what cannot be a cluster is said in one line, before anything is done."""

import socket
import sys
import threading

import pytest

from torchqm.cli import main as command
from torchqm.cli.backends import check_backend, knock
from torchqm.cli.console import UserError


@pytest.fixture
def door():
    """A port at which somebody listens; what is sent there to greet whoever comes."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def greet(text):
            def answer():
                visitor, _ = server.accept()
                with visitor:
                    visitor.sendall(text)

            threading.Thread(target=answer, daemon=True).start()
            return f"tcp://127.0.0.1:{server.getsockname()[1]}"

        yield greet


def test_options_that_do_not_go_together(tmp_path, capsys):
    out = tmp_path / "out"
    for words, text in (
        (["--backend", "dask"], "--backend dask: the scheduler's address is needed too"),
        (["--address", "tcp://127.0.0.1:8786"], "--address tcp://127.0.0.1:8786: is of a Dask cluster, so add"),
        (["--backend", "dask", "--address", "127.0.0.1:8786"], "--address 127.0.0.1:8786: is no tcp://HOST:PORT"),
        (["--backend", "dask", "--address", "tcp://somewhere"], "--address tcp://somewhere: is no tcp://HOST:PORT"),
        (["--backend", "dask", "--address", "tcp://a:99999"], "--address tcp://a:99999: is no tcp://HOST:PORT"),
        (["--backend", "dask", "--address", "http://a:8786"], "--address http://a:8786: is no tcp://HOST:PORT"),
    ):
        assert command.main(["benchmark", "synthetic:", "--out", str(out), *words]) == 2
        err = capsys.readouterr().err
        assert text in err
        assert err.count("\n") == 1
    assert not out.exists()
    check_backend("local", None)
    check_backend("dask", "tcp://[::1]:8786")


def test_the_extra_is_named_where_it_is_not_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UserError, match=r"pip install 'torchqm\[distributed\]'"):
        check_backend("dask", "tcp://127.0.0.1:8786")


def test_nobody_there_or_somebody_else(door):
    with socket.create_server(("127.0.0.1", 0)) as server:
        closed = f"tcp://127.0.0.1:{server.getsockname()[1]}"
    with pytest.raises(UserError, match=f"{closed}: no Dask scheduler answers there"):
        knock(closed, 5.0)
    with pytest.raises(UserError, match="what answers there is no Dask scheduler"):
        knock(door(b"SSH-2.0-OpenSSH_9.6\r\n"), 5.0)
    with pytest.raises(UserError, match="what answers there is no Dask scheduler"):
        knock(door(b""), 5.0)
    with socket.create_server(("127.0.0.1", 0)) as server:  # takes the call and says nothing
        silent = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(UserError, match=r"no Dask scheduler answers there \(within 0 s\)"):
            knock(silent, 0.1)
