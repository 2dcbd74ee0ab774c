"""A small certificate authority for one arm: a key and a certificate for every process of its runs.

Behind `octarm keys`, which makes them, and `octarm run --keys`, which looks at this machine's before anything
is started. What a run does with them: supervise.secured. EC P-256, X.509; the only module that imports
`cryptography`.
"""

from __future__ import annotations

import datetime
import ipaddress
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from wire.errors import UsageError

AUTHORITY = "ca"
"""Name of the authority's files."""
LOOPBACK = ("localhost", "127.0.0.1", "::1")
"""Every process may be dialled here: runs on one machine need nothing else."""
MOST_DAYS = 3650
BACKDATED = datetime.timedelta(hours=1)
"""Clocks of other hosts may be behind."""


@dataclass(frozen=True)
class Holder:
    """A process that gets a certificate, and the addresses that others dial it at."""

    name: str
    addresses: tuple[str, ...] = ()


def certificate_path(directory: Path, name: str) -> Path:
    """Where the certificate of a process, or of the authority, is."""
    return directory / f"{name}.pem"


def key_path(directory: Path, name: str) -> Path:
    """Where its private key is."""
    return directory / f"{name}.key"


# -- making -----------------------------------------------------------------------------------------


def make_keys(directory: Path, holders: Sequence[Holder], days: int) -> datetime.datetime:
    """Make an authority and a certificate for everybody; returns the instant at which they expire.

    The directory is made, mode 0700; private keys have mode 0600. UsageError if something is there already or
    cannot be written: nothing is written over.
    """
    if not 1 <= days <= MOST_DAYS:
        raise UsageError(f"--days: expected 1..{MOST_DAYS}, got {days}")
    now = datetime.datetime.now(datetime.UTC).replace(microsecond=0)
    validity = (now - BACKDATED, now + datetime.timedelta(days=days))
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        if found := next((file.name for file in directory.iterdir()), None):
            raise UsageError(
                f"--out {directory}: there is something in it already ({found}); keys are never written "
                "over, give a directory that is empty or does not exist"
            )
        directory.chmod(0o700)
        own_key = ec.generate_private_key(ec.SECP256R1())
        # A name of its own: what two authorities signed is never mixed up.
        title = f"octarm authority {x509.random_serial_number():040x}"[:64]
        own = _authority(title, own_key, validity)
        _write(directory, AUTHORITY, own, own_key)
        for holder in holders:
            key = ec.generate_private_key(ec.SECP256R1())
            _write(directory, holder.name, _signed(holder, key, own, own_key, validity), key)
    except OSError as error:
        raise UsageError(
            f"--out {directory}: {error.strerror or error}; give a directory that can be written"
        ) from None
    return validity[1]


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


Validity = tuple[datetime.datetime, datetime.datetime]


def _begun(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, validity: Validity
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(validity[0])
        .not_valid_after(validity[1])
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _authority(title: str, key: ec.EllipticCurvePrivateKey, validity: Validity) -> x509.Certificate:
    return (
        _begun(_name(title), _name(title), key, validity)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs_certificates=True), critical=True)
        .sign(key, hashes.SHA256())
    )


def _signed(
    holder: Holder,
    key: ec.EllipticCurvePrivateKey,
    own: x509.Certificate,
    own_key: ec.EllipticCurvePrivateKey,
    validity: Validity,
) -> x509.Certificate:
    addresses = dict.fromkeys((*LOOPBACK, *holder.addresses))
    both = [
        ExtendedKeyUsageOID.SERVER_AUTH,
        ExtendedKeyUsageOID.CLIENT_AUTH,
    ]  # nodes dial and listen
    return (
        _begun(_name(holder.name), own.subject, key, validity)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(both), critical=False)
        .add_extension(x509.SubjectAlternativeName(map(_general_name, addresses)), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(own_key.public_key()), critical=False
        )
        .sign(own_key, hashes.SHA256())
    )


def _general_name(address: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        return x509.DNSName(address)


def _write(
    directory: Path, name: str, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey
) -> None:
    with certificate_path(directory, name).open("xb") as file:
        file.write(certificate.public_bytes(serialization.Encoding.PEM))
    private = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    handle = os.open(key_path(directory, name), os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(handle, "wb") as file:
        file.write(private)


# -- looking ----------------------------------------------------------------------------------------


def check_keys(directory: Path, holders: Iterable[Holder]) -> None:
    """Raise UsageError if one of these processes' certificates could not be used now, saying why."""
    path = certificate_path(directory, AUTHORITY)
    own = _read_certificate(path)
    for holder in holders:
        _check(directory, holder, own, path)


def _check(directory: Path, holder: Holder, own: x509.Certificate, authority: Path) -> None:
    path = certificate_path(directory, holder.name)
    certificate = _read_certificate(path)
    _check_time(certificate, path)
    _check_time(own, authority)
    try:
        certificate.verify_directly_issued_by(own)
    except (ValueError, TypeError, InvalidSignature):
        raise UsageError(
            f"--keys: {path} is not signed by {authority}; take both from one `octarm keys`"
        ) from None
    if certificate.subject != _name(holder.name):
        raise UsageError(
            f"--keys: {path}: expected the certificate of {holder.name}, got that of "
            f"{certificate.subject.rfc4514_string()}; copy the right one"
        )
    key_file = key_path(directory, holder.name)
    try:
        key = serialization.load_pem_private_key(key_file.read_bytes(), None)
    except OSError as error:
        raise UsageError(
            f"--keys: {key_file}: {error.strerror}; `octarm keys` makes it beside the certificate"
        ) from None
    except (ValueError, TypeError) as error:
        raise UsageError(
            f"--keys: {key_file}: not a private key that can be read ({error}); copy it again"
        ) from None
    if key.public_key() != certificate.public_key():
        raise UsageError(
            f"--keys: {key_file} does not belong to {path}; copy both from one `octarm keys`"
        )
    _check_addresses(certificate, path, holder)


def _read_certificate(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except OSError as error:
        raise UsageError(
            f"--keys: {path}: {error.strerror}; `octarm keys` makes it, with as many --nodes as the run has"
        ) from None
    except ValueError as error:
        raise UsageError(f"--keys: {path}: not a certificate ({error}); copy it again") from None


def _check_time(certificate: x509.Certificate, path: Path) -> None:
    now = datetime.datetime.now(datetime.UTC)
    begin, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if not begin <= now <= end:
        word = "expired" if now > end else "is not valid yet"
        raise UsageError(
            f"--keys: {path} {word}: it is for {begin:%Y-%m-%d %H:%M} to {end:%Y-%m-%d %H:%M} UTC, and here "
            f"it is {now:%Y-%m-%d %H:%M}; make new keys with `octarm keys`, or set the clock"
        )


def _check_addresses(certificate: x509.Certificate, path: Path, holder: Holder) -> None:
    alternative = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName)
    for address in holder.addresses:
        if _general_name(address) not in alternative.value:
            raise UsageError(
                f"--keys: {path} is not for the address {address}, where others dial {holder.name}; make "
                "keys with the hosts file of the run: `octarm keys --hosts`"
            )
