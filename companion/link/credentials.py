"""Who we are on Zenoh: the files that `companion keys` makes, looked at before anything relies on them.

Zenoh opens a session with a certificate that nobody accepts, and keeps trying in silence. So the files are
held against each other first: a wrong, foreign or expired one stops the start, in words.
"""

from __future__ import annotations

import ssl
import stat
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from companion.network_settings import RangesSettings

AUTHORITY, CERTIFICATE, KEY = "ca.pem", "certificate.pem", "key.pem"
"""The files in `ranges.tls`."""


class CredentialsError(ValueError):
    """These files do not let anybody in; the text says which, why and what to do."""


class Credentials(NamedTuple):
    """A certificate with its key, and the authority that it is believed by."""

    authority: Path
    certificate: Path
    key: Path
    name: str
    """The common name, such as `vehicle/uav1`: what the router's access control goes by."""
    until: datetime
    """The end of its validity."""


def read(directory: Path) -> Credentials:
    """The credentials in a directory. Raises CredentialsError."""
    return read_files(directory / AUTHORITY, directory / CERTIFICATE, directory / KEY)


def read_files(authority: Path, certificate: Path, key: Path) -> Credentials:
    """Look at the three files as the other side will. Raises CredentialsError."""
    for path in (authority, certificate, key):
        _can_be_read(path)
    if key.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise CredentialsError(f"{key}: others on this machine can get at it: chmod 600 {key}")
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        server.load_verify_locations(authority)
    except ssl.SSLError:
        raise CredentialsError(f"{authority}: is no certificate in PEM form") from None
    try:
        server.load_cert_chain(certificate, key)
    except ssl.SSLError:
        raise CredentialsError(
            f"{certificate} and {key.name} do not belong together, or are not in PEM form: copy both anew"
        ) from None
    server.verify_mode = ssl.CERT_REQUIRED
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname, client.verify_mode = False, ssl.CERT_NONE
    client.load_cert_chain(certificate, key)
    try:
        subject, until = _as_seen(server, client)
    except ssl.SSLCertVerificationError as error:
        raise CredentialsError(_why(error, authority, certificate)) from None
    return Credentials(authority, certificate, key, subject, until)


def _can_be_read(path: Path) -> None:
    try:
        with path.open("rb"):
            pass
    except OSError as error:
        raise CredentialsError(
            f"{path}: {error.strerror}; `companion keys` makes a directory with {AUTHORITY}, {CERTIFICATE} "
            f"and {KEY}"
        ) from None


def _as_seen(server: ssl.SSLContext, client: ssl.SSLContext) -> tuple[str, datetime]:
    """Name and end of the client's certificate: a handshake in memory, in which the server verifies it."""
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ours = client.wrap_bio(to_client, to_server)
    theirs = server.wrap_bio(to_server, to_client, server_side=True)
    waiting = [ours, theirs]
    while waiting:
        for side in tuple(waiting):
            try:
                side.do_handshake()
                waiting.remove(side)
            except ssl.SSLWantReadError:
                pass
    seen = theirs.getpeercert()
    assert seen is not None
    subject: tuple[tuple[tuple[str, str], ...], ...] = seen["subject"]  # type: ignore[assignment]
    names = dict(pair for part in subject for pair in part)
    ends = datetime.fromtimestamp(ssl.cert_time_to_seconds(str(seen["notAfter"])), UTC)
    return names.get("commonName", ""), ends


def _why(error: ssl.SSLCertVerificationError, authority: Path, certificate: Path) -> str:
    words = error.verify_message
    if "expired" in words:
        return f"{certificate}: has expired; make another: companion keys DIR --renew ROLE/NAME"
    if "not yet valid" in words:
        return f"{certificate}: is not valid yet: is this computer's clock set?"
    if "issuer" in words or "self-signed" in words or "signature" in words:
        return f"{certificate}: was not made by the authority in {authority.name}: copy all three files anew"
    return f"{certificate}: {words}"


def contradictions(r: RangesSettings) -> list[str]:
    """What keeps a door open, or shut for ourselves: endpoints and `ranges.tls` that do not go together."""
    doors = [("ranges.connect", e) for e in r.connect] + [("ranges.listen", e) for e in r.listen]
    if not r.tls:
        return [
            f"{key} = {e!r}: needs ranges.tls, the directory that `companion keys` made for this one"
            for key, e in doors
            if e.startswith(("tls/", "quic/"))
        ]
    problems = [
        f"{key} = {e!r}: is not encrypted, but ranges.tls is set; write tls/{e.partition('/')[2]}"
        for key, e in doors
        if not e.startswith("tls/")
    ]
    if r.listen:
        problems.append("ranges.listen with ranges.tls: only a router guards who writes what; connect to it")
    if r.multicast_scouting:
        problems.append("ranges.multicast_scouting with ranges.tls: it finds peers that no router guards")
    return problems


def tls_config(c: Credentials) -> dict[str, object]:
    """Zenoh's `transport/link/tls`: both sides show certificates, and the router's must name its address."""
    return {
        "root_ca_certificate": str(c.authority),
        "enable_mtls": True,
        "connect_certificate": str(c.certificate),
        "connect_private_key": str(c.key),
        "verify_name_on_connect": True,
    }
