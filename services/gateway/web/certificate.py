"""The certificate for https: the configured file, or a self-signed one created on first use."""

import datetime
import ipaddress
import ssl
from collections.abc import Iterable
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from kouxing.shared.errors import UserError
from kouxing.shared.files.output_file import write_private
from kouxing.shared.files.user_file import open_file
from kouxing.shared.monitoring.logs import LOG

_MAX_BYTES = 1 << 20
_VALID_DAYS = 397  # browsers reject certificates that are valid for longer


def load_tls_context(certificate: Path, hosts: Iterable[str]) -> ssl.SSLContext:
    """Load the TLS context from a PEM file with a certificate and its private key.

    If the file does not exist, it is created with a self-signed certificate for the hosts. Raises
    ``UserError`` if the file cannot be read or written, or does not contain a certificate and its
    key.
    """
    now = datetime.datetime.now(datetime.UTC)
    try:
        if not certificate.exists():
            write_private(certificate, create_self_signed(hosts, now))
        with open_file(certificate, _MAX_BYTES) as file:  # OpenSSL would block on a FIFO
            pem = file.read()
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        context.load_cert_chain(certificate)
    except (OSError, ssl.SSLError) as error:
        raise UserError(
            f"gateway.https: {certificate}: {error.strerror or error}; use a PEM file with "
            "a certificate and its private key, or the path of a file to create"
        ) from None
    if problem := find_validity_problem(pem, now):
        LOG.warning("gateway.https: %s %s", certificate, problem)
    return context


def find_validity_problem(pem: bytes, now: datetime.datetime) -> str:
    """Return why browsers reject a certificate at this time; empty if it is valid or unreadable.

    OpenSSL, which serves the certificate, reads more formats, such as TRUSTED CERTIFICATE.
    """
    try:
        certificate = x509.load_pem_x509_certificate(pem)
    except ValueError:
        return ""
    start, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if start <= now <= end:
        return ""
    return (
        f"is valid from {start:%Y-%m-%d} to {end:%Y-%m-%d}, but the clock of this machine says"
        f" {now:%Y-%m-%d}, so browsers reject it; correct the clock or replace the file (if it"
        " does not exist, the gateway creates it at the next start)"
    )


def create_self_signed(hosts: Iterable[str], now: datetime.datetime) -> bytes:
    """Return a private key and a certificate that is valid from a day before ``now``, as PEM."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "kouxing")])
    names = [_general_name(host) for host in dict.fromkeys(hosts)]
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=_VALID_DAYS - 1))
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    private = key.private_bytes(
        pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return private + certificate.public_bytes(pem)


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)
