"""A site's directory: its authority, and a directory to copy for everybody who connects.

    authority/      ca.pem, ca.key      keep it offline: whoever has ca.key lets anybody in
    router/         ca.pem, certificate.pem, key.pem, zenoh.json5
    beacon-b1/      ca.pem, certificate.pem, key.pem
    vehicle-uav1/   ca.pem, certificate.pem, key.pem

What is there is what counts: nothing else remembers who belongs to the site.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from datetime import datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

from companion.keys import certificates, router
from companion.keys.certificates import MOST_COMMON_NAME, Identity, Role
from companion.link.credentials import AUTHORITY, CERTIFICATE, KEY
from companion.network_settings import NAME_RULE, is_name

AUTHORITY_DAYS = 3650
SOON = timedelta(days=30)
"""So long before the end it is told."""
ROUTER_FILE = "zenoh.json5"


class KeysError(Exception):
    """It cannot be done; the text says what, why and what to do."""


class Member(NamedTuple):
    """Somebody of the site, and how long the certificate holds."""

    role: Role
    name: str
    until: datetime
    addresses: tuple[str, ...] = ()

    @property
    def who(self) -> str:
        """`beacon/b1`, or `router`."""
        return (
            Role.ROUTER.value if self.role is Role.ROUTER else certificates.common_name(self.role, self.name)
        )


class Listing(NamedTuple):
    """Everybody, with the authority's own end."""

    site: str
    until: datetime
    members: tuple[Member, ...]


def create(directory: Path, site: str, now: datetime) -> None:
    """Make the authority of a new site. Raises KeysError where there is one, or the name cannot be one."""
    check_name("site", site)
    if (directory / "authority").exists():
        raise KeysError(f"{directory}/authority is there already")
    ca = certificates.authority(site, now, AUTHORITY_DAYS)
    _write(directory, "authority", {AUTHORITY: ca.certificate_pem(), "ca.key": ca.key_pem()})


def add(
    directory: Path, role: Role, name: str, now: datetime, days: int, addresses: tuple[str, ...] = ()
) -> Member:
    """Make somebody's directory. Raises KeysError where it is there already."""
    check_name(role.value, name)
    for address in addresses:
        check_address(address)
    ca = authority_of(directory)
    issued = certificates.issue(ca, role, name, now, days, addresses)
    files = {
        AUTHORITY: ca.certificate_pem(),
        CERTIFICATE: issued.certificate_pem(),
        KEY: issued.key_pem(),
    }
    _write(directory, _folder(role, name), files)
    return Member(role, name, issued.certificate.not_valid_after_utc, addresses)


def renew(directory: Path, member: Member, now: datetime, days: int) -> Member:
    """A new key and certificate in the place of the old ones, for the same name; the old are deleted."""
    authority_of(directory)  # raises before anything is moved
    place = directory / _folder(member.role, member.name)
    aside = Path(tempfile.mkdtemp(prefix=".old-", dir=directory)) / "old"
    place.rename(aside)
    renewed = add(directory, member.role, member.name, now, days, member.addresses)
    for path in aside.glob(f"{ROUTER_FILE}*"):
        path.rename(place / path.name)
    shutil.rmtree(aside.parent)
    return renewed


def listing(directory: Path) -> Listing:
    """Who belongs to the site. Raises KeysError where this is no site's directory."""
    ca = _certificate(directory / "authority" / AUTHORITY)
    found = []
    for path in sorted(directory.glob(f"*/{CERTIFICATE}")):
        certificate = _certificate(path)
        role, _, name = certificates.name_of(certificate).partition("/")
        if role not in {r.value for r in Role} or path.parent.name != _folder(Role(role), name):
            raise KeysError(
                f"{path}: is the certificate of {role}/{name}: it does not belong in this directory"
            )
        found.append(
            Member(Role(role), name, certificate.not_valid_after_utc, certificates.addresses(certificate))
        )
    order = list(Role)
    site = certificates.name_of(ca).partition("/")[2]
    return Listing(
        site, ca.not_valid_after_utc, tuple(sorted(found, key=lambda m: (order.index(m.role), m.name)))
    )


def write_router_file(directory: Path, port: int) -> str:
    """Bring the router's rules up to date with who is there. The result says what was done; '' for nothing.

    Raises KeysError where the file was changed so that the rules are not found in it.
    """
    path = directory / "router" / ROUTER_FILE
    everybody = listing(directory)
    site = router.Site(everybody.site, tuple((m.role, m.name) for m in everybody.members))
    if not path.exists():
        path.write_text(router.router_config(site, port), encoding="utf-8")
        return f"{path}: written"
    before = path.read_text(encoding="utf-8")
    try:
        after = router.with_access_control(before, site)
    except ValueError as error:
        raise KeysError(f"{path}: {error}; move it away, and it is written anew") from None
    if after == before:
        return ""
    path.with_suffix(".json5.before").write_text(before, encoding="utf-8")
    path.write_text(after, encoding="utf-8")
    return f"{path}: its rules are new (as it was: {path.name}.before); start the router again"


def authority_of(directory: Path) -> Identity:
    """The site's authority with its key. Raises KeysError where the key is elsewhere, as it should be."""
    path = directory / "authority" / "ca.key"
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), password=None)
    except OSError as error:
        raise KeysError(
            f"{path}: {error.strerror}; the authority's key is needed to make certificates: put it back"
        ) from None
    except ValueError:
        raise KeysError(f"{path}: is no private key in PEM form") from None
    certificate = _certificate(directory / "authority" / AUTHORITY)
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise KeysError(f"{path}: is not the key of {AUTHORITY} beside it")
    return Identity(key, certificate)


def _certificate(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except OSError as error:
        raise KeysError(f"{path}: {error.strerror}; is this a directory of `companion keys`?") from None
    except ValueError:
        raise KeysError(f"{path}: is no certificate in PEM form") from None


def _folder(role: Role, name: str) -> str:
    return Role.ROUTER.value if role is Role.ROUTER else f"{role.value}-{name}"


def _write(directory: Path, name: str, files: dict[str, bytes]) -> None:
    """All files or none; private keys are never readable to others, not even for a moment."""
    place = directory / name
    if place.exists():
        raise KeysError(f"{place} is there already: nothing is overwritten; --renew makes it anew")
    directory.mkdir(parents=True, exist_ok=True)
    draft = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=directory))  # mode 0700
    try:
        for file, content in files.items():
            mode = 0o600 if file.endswith(".key") or file == KEY else 0o644
            with os.fdopen(os.open(draft / file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as out:
                out.write(content)
        draft.rename(place)
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise


def check_name(what: str, name: str) -> None:
    """Raises KeysError where this cannot be in a key and in a certificate."""
    if not is_name(name):
        raise KeysError(f"{what} {name[:80]!r}: {NAME_RULE}")
    if len(f"{what}/{name}") > MOST_COMMON_NAME:
        most = MOST_COMMON_NAME - len(what) - 1
        raise KeysError(f"{what} {name!r}: at most {most} characters fit into a certificate's name")


def check_address(text: str) -> None:
    """Raises KeysError where this is no host."""
    if not certificates.is_address(text):
        raise KeysError(f"router {text!r}: a host name or an IP address alone, such as 192.168.1.10")
