"""The certificates of a site: one authority, and one certificate for whoever connects. Elliptic curve P-256.

The common name says who somebody is (`beacon/b1`); the router's access control goes by it. It is not a host
name: the router's addresses stand in its certificate's alternative names, and whoever connects checks them.
"""

from __future__ import annotations

import ipaddress
import re
from datetime import datetime, timedelta
from enum import Enum
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

MOST_COMMON_NAME = 64
"""X.520's upper bound."""
_CLOCK_SKEW = timedelta(minutes=10)
"""Valid from a little before it was made: a beacon's clock may be behind."""


class Role(Enum):
    """What somebody is at a site; the first part of the common name."""

    ROUTER = "router"
    BEACON = "beacon"
    TAG = "tag"
    VEHICLE = "vehicle"
    WATCHER = "watcher"


class Identity(NamedTuple):
    """A private key and its certificate."""

    key: ec.EllipticCurvePrivateKey
    certificate: x509.Certificate

    def key_pem(self) -> bytes:
        """The private key, not encrypted: PKCS#8, which Zenoh and zenoh-pico read."""
        return self.key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )

    def certificate_pem(self) -> bytes:
        """The certificate."""
        return self.certificate.public_bytes(serialization.Encoding.PEM)


def common_name(role: Role, name: str) -> str:
    """`beacon/b1`. A name holds no `/`, so that no beacon can be called like a vehicle."""
    return f"{role.value}/{name}"


def name_of(certificate: x509.Certificate) -> str:
    """The common name of a certificate; '' where it has none."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def authority(site: str, now: datetime, days: int) -> Identity:
    """A new authority for a site: it signs certificates, and nothing beneath it may."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(f"site/{site}")
    certificate = (
        _builder(name, name, key, key, now, now + timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    return Identity(key, certificate)


def issue(
    ca: Identity, role: Role, name: str, now: datetime, days: int, addresses: tuple[str, ...] = ()
) -> Identity:
    """A new key and certificate. `addresses`: host names and IP addresses that a router is reached at.

    It is not valid beyond the authority's own end.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    subject = _name(common_name(role, name))
    ends = min(now + timedelta(days=days), ca.certificate.not_valid_after_utc)
    builder = _builder(subject, ca.certificate.subject, key, ca.key, now, ends)
    usages = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if role is Role.ROUTER:  # a router connects to other routers, too
        usages.append(ExtendedKeyUsageOID.SERVER_AUTH)
        names = x509.SubjectAlternativeName([_address(a) for a in addresses])
        builder = builder.add_extension(names, critical=False)
    certificate = (
        builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
        .sign(ca.key, hashes.SHA256())
    )
    return Identity(key, certificate)


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    issuer_key: ec.EllipticCurvePrivateKey,
    now: datetime,
    ends: datetime,
) -> x509.CertificateBuilder:
    by = x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer_key.public_key())
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCK_SKEW)
        .not_valid_after(ends)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(by, critical=False)
    )


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _usage(signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs,
        key_cert_sign=signs,
        crl_sign=signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _address(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        return x509.DNSName(text)


def is_address(text: str) -> bool:
    """True for an IP address or a host name."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return re.fullmatch(r"(?!-)[A-Za-z0-9-]{1,63}(\.(?!-)[A-Za-z0-9-]{1,63})*", text) is not None
    return True


def addresses(certificate: x509.Certificate) -> tuple[str, ...]:
    """The host names and IP addresses in a certificate."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in names)
