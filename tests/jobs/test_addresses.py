"""Addresses that lead to no scheduler: one line, before there is a client that would go on trying."""

import socket

import pytest

from lingo_mi.common.errors import InputError
from lingo_mi.jobs import cluster

distributed = pytest.importorskip('distributed')


def refused(address, words):
    with pytest.raises(InputError, match=words), cluster.opened(address, None):
        pass


@pytest.mark.parametrize('address, words', [
    ('', '^cluster is empty; give the scheduler'), ('foo', '^cluster=foo: no scheduler answers .*missing port.*tcp://HOST:8786'),
    ('10.255.255.1', 'missing port'), ('http://127.0.0.1:8787/status', "is the dashboard's address; give the scheduler's"),
    ('tls://127.0.0.1:1', 'TLS'), ('tcp://127.0.0.1:1', 'timed out'),
])  # fmt: skip
def test_addresses(monkeypatch, address, words):
    monkeypatch.setattr(cluster, 'ANSWER', 1.0 if words == 'timed out' else 60.0)
    refused(address, words)


@pytest.mark.parametrize('text', ['{', '{"address": 3}', '{}', '[]'])
def test_files(tmp_path, text):
    (tmp_path / 'a.json').write_text(text)
    refused(tmp_path / 'a.json', '^cluster=.*a.json: no scheduler answers')


def test_a_port_of_something_else(monkeypatch):
    """It takes the connection, and never answers."""
    monkeypatch.setattr(cluster, 'ANSWER', 1.0)
    with socket.create_server(('127.0.0.1', 0)) as server:
        refused(f'tcp://127.0.0.1:{server.getsockname()[1]}', 'no scheduler answers .*timed out')
