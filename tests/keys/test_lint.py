"""`companion keys --check`: what Zenoh accepts in silence, and a router must not have."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.exits import Exit
from companion.keys.lint import lint
from tests.keys.site import NOW, keys, make


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("lint"))


def test_what_is_made_has_nothing_wrong(place: Path) -> None:
    assert keys("--check", place / "router/zenoh.json5") == Exit.OK


DESK = '"subjects": ["watcher/desk"], "rules": ["ask", "be answered"]'


@pytest.mark.parametrize(
    ("was", "becomes", "words"),
    [
        ("enabled: true,\n    default", "enabled: false,\n    default", "access_control.enabled"),
        ('default_permission: "deny"', 'default_permission: "allow"', "default_permission"),
        (DESK, DESK.replace('"ask"', '"aks"'), "the rule 'aks', which is not there"),
        (DESK, DESK.replace("desk", "dsek"), "the subject 'watcher/dsek', which is not there"),
        (DESK, DESK.replace('"ask", ', '"beacon/b1 tells", '), "lets watcher/desk write uwb/v1/lab/b1/**"),
        ('["uwb/v1/lab/b1/**"]', '["uwb/v1/lab/**"]', "lets beacon/b1 write uwb/v1/lab/**"),
        ('["uwb/v1/lab/b1/**"]', '["uwb/v1/lab/b1"]', "'uwb/v1/lab/b1' is no key of a beacon"),
        ('["uwb/v1/lab/b1/**"]', '["uwb/v2/lab/b1/**"]', "so that it names nothing"),
        ('"cert_common_names": ["beacon/b1"]', '"interfaces": ["eth0"]', "so that it is everybody"),
        (
            '"cert_common_names": ["beacon/b1"]',
            '"cert_common_names": ["beacon/b8"]',
            "beacon/b8: has rules, but no certificate",
        ),
        ('"id": "beacon/b1 tells"', '"id": "beacon/b2 tells"', "there are two of this id"),
        ("enable_mtls: true", "enable_mtls: false", "enable_mtls: must be true"),
        (
            '["tls/0.0.0.0:7447"]',
            '["tls/0.0.0.0:7447", "tcp/0.0.0.0:7448"]',
            "tcp/0.0.0.0:7448 is in the clear",
        ),
        ('["tls/0.0.0.0:7447"]', "[]", "there are none"),
        ('listen_private_key: "key.pem"', 'listen_private_key: "../beacon-b1/key.pem"', "belong together"),
        ('listen_certificate: "certificate.pem"', 'listen_certificate: "gone.pem"', "gone.pem"),
        ('mode: "router"', 'mode: "peer"', "mode: must be"),
        ("multicast: { enabled: false }", "multicast: { enabled: true }", "scouting.multicast"),
    ],
)
def test_each_silent_mistake_is_named(place: Path, was: str, becomes: str, words: str) -> None:
    text = (place / "router/zenoh.json5").read_text()
    assert was in text
    path = place / "router/wrong.json5"
    path.write_text(text.replace(was, becomes, 1))
    problems = lint(path, NOW)
    assert any(words in problem for problem in problems), problems
    assert keys("--check", path) == Exit.FAULTY


def test_who_has_no_rule_yet_is_named(tmp_path: Path) -> None:
    place = make(tmp_path / "keys")
    before = (place / "router/zenoh.json5").read_bytes()
    assert keys(place, "--beacon", "b3") == Exit.OK
    (place / "router/zenoh.json5").write_bytes(before)
    (problem,) = lint(place / "router/zenoh.json5", NOW)
    assert problem.startswith("beacon/b3: has a certificate, but no rule")


RULE = '{ "access_control": { "rules": [{ "id": "a", "key_exprs": ["uwb//b1"] }] } }'


@pytest.mark.parametrize("content", [None, "{", "{ mode: 3 }", '{ "acess_control": {} }', RULE])
def test_what_is_no_configuration_is_refused_in_words(
    content: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "zenoh.json5"
    if content is not None:
        path.write_text(content)
    assert keys("--check", path) == Exit.USAGE
    assert str(path) in capsys.readouterr().err
