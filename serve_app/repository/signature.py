"""Signature of a bundle: OpenSSF Model Signing, in the file `model.sig` beside the files that it covers.

The hash that identifies a bundle does not depend on it, so a bundle can be signed after it was exported, and again
with another key. It covers SHA256SUMS and every file listed there; other tools for the format can check it as well.
"""

from __future__ import annotations

import base64
import json
import logging
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from rlservo.bundle.bundle import SUMS_FILE, Bundle
from rlservo.bundle.regular_files import blocks, open_regular
from rlservo.errors import BundleError, UsageError
from rlservo.extras import needs_extra

SIGNATURE_FILE = "model.sig"
MAX_SIGNATURE_BYTES = 1 << 20
MISMATCH = "Signature mismatch: "  # the library's message where the key is right and the files are not
logger = logging.getLogger(__name__)


def sign(bundle: Bundle, key: Path, certificate: Path | None = None) -> Path:
    """Write the signature of a bundle, and return its file.

    `key` is an elliptic private key (P-256, P-384, P-521) in PEM; with a `certificate` of that key, followed by those
    that issued it, the signature is checked against the issuer instead. Raises UsageError, BundleError.
    """
    with needs_extra("sign"):
        from model_signing import hashing, signing
    config = signing.Config()
    try:
        if certificate is None:
            config.use_elliptic_key_signer(private_key=key)
        else:
            config.use_certificate_signer(
                private_key=key, signing_certificate=certificate, certificate_chain=[certificate]
            )
    except (ValueError, TypeError, AttributeError) as error:  # another kind of key, one with a password
        given = f"{key} with {certificate}" if certificate is not None else key
        raise UsageError(
            f"{given} cannot sign: expected an elliptic private key (P-256, P-384 or P-521) in PEM, without a password"
            f"{', and its certificate' if certificate is not None else ''} ({error})"
        ) from None
    config.set_hashing_config(hashing.Config().set_ignored_paths(paths=[], ignore_git_paths=False))
    with _copy(bundle) as copy:
        config.sign(copy, made := copy.parent.with_name(SIGNATURE_FILE))
        file = bundle.path / SIGNATURE_FILE
        with tempfile.TemporaryDirectory(prefix=".signature-", dir=bundle.path) as beside:  # no one's link is there
            shutil.copyfile(made, new := Path(beside) / SIGNATURE_FILE)
            new.replace(file)
    return file


def remove_signature(folder: Path) -> bool:
    """Remove the signature of a bundle that was changed; return whether there was one."""
    with suppress(FileNotFoundError):
        (folder / SIGNATURE_FILE).unlink()
        return True
    return False


def read_signature(folder: Path) -> bytes:
    """Return the content of a bundle's signature, unchecked except that it is one.

    Raises FileNotFoundError, and BundleError for anything else, such as a link to a file that is not to be published.
    """
    file = folder / SIGNATURE_FILE
    try:
        with open_regular(file, MAX_SIGNATURE_BYTES) as stream:
            content = b"".join(blocks(stream, MAX_SIGNATURE_BYTES))
        _contents(content)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise BundleError(f"{file} cannot be read: {error.strerror or error}") from None
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        raise BundleError(f"{file} is not an OpenSSF Model Signing signature by a key or a certificate") from None
    return content


def check_signature(bundle: Bundle, keys: Path) -> str:
    """Return the name of the key that signed a bundle.

    `keys` are public keys and issuers' certificates as `trusted` reads them. What is checked are the bytes whose
    hashes `load_bundle` compared, so a bundle with this `digest` is what was signed. Raises BundleError, UsageError.
    """
    verifiers = trusted(keys)
    from cryptography import x509

    file = bundle.path / SIGNATURE_FILE
    try:
        content = read_signature(bundle.path)
    except FileNotFoundError:
        raise BundleError(
            f"{bundle.path} has no {SIGNATURE_FILE}: expected a signature by a key of {keys} (`rlservo sign`)"
        ) from None
    names, certificates = _contents(content)
    try:
        fault = _fault_of([x509.load_der_x509_certificate(each) for each in certificates])
    except ValueError as error:
        fault = f"has a malformed certificate ({str(error)[:100]})"
    with _copy(bundle) as copy:
        (beside := copy.parent.with_name(SIGNATURE_FILE)).write_bytes(content)
        for name, verify in verifiers.items():
            try:
                verify(copy, beside)
            except Exception as error:  # whatever a file from outside makes the library raise
                if not str(error).startswith(MISMATCH):
                    continue
                reason = str(error).removeprefix(MISMATCH)[:300]
                raise BundleError(f"{file}, made with {name}, does not match these files: {reason}") from None
            if SUMS_FILE not in names:  # the format allows this, and an expired certificate
                raise BundleError(f"{file}, made with {name}, does not cover {SUMS_FILE}, and so not the other files")
            if fault:
                raise BundleError(f"{file} {fault}")
            return name
    also = f"; it {fault}" if fault else ""
    raise BundleError(f"{file} was made with none of the keys in {keys} ({', '.join(verifiers)}){also}")


def trusted(keys: Path) -> dict[str, Callable[[Path, Path], object]]:
    """Return a check of (files, signature) by file name, for each PEM file in a folder, or for one file.

    A file holds one public key, or certificates of issuers; an expired one, or one for other uses, is left out. Raises
    UsageError.
    """
    with needs_extra("sign"):
        from cryptography import x509
        from cryptography.exceptions import UnsupportedAlgorithm
        from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePublicKey
        from cryptography.hazmat.primitives.serialization import load_pem_public_key
        from model_signing import verifying
    checks: dict[str, Callable[[Path, Path], object]] = {}
    expected = "expected public elliptic keys or certificates, as PEM files in a folder"
    try:
        others = [f.name for f in sorted(keys.iterdir()) if f.suffix != ".pem" and f.is_file()] if keys.is_dir() else []
        if others:
            logger.warning("%s: not *.pem, so not used as keys: %s", keys, ", ".join(others))
        for file in sorted(keys.glob("*.pem")) if keys.is_dir() else [keys]:
            content = file.read_bytes()
            if b"PRIVATE KEY" in content:
                raise UsageError(f"{file} holds a private key: {expected}")
            if b"BEGIN CERTIFICATE" in content:
                if fault := _fault_of(x509.load_pem_x509_certificates(content)):
                    logger.warning("%s %s: it is not used", file, fault)
                    continue
                config = verifying.Config().use_certificate_verifier(certificate_chain=[file])
            elif isinstance(load_pem_public_key(content), EllipticCurvePublicKey):
                config = verifying.Config().use_elliptic_key_verifier(public_key=file)
            else:
                raise ValueError("another kind of key")
            checks[file.name] = config.verify
    except OSError as error:
        raise UsageError(f"{error.filename} cannot be read ({error.strerror}): {expected}") from None
    except (ValueError, UnsupportedAlgorithm) as error:
        raise UsageError(f"{file} holds no key ({str(error)[:100]}): {expected}") from None
    if not checks:
        raise UsageError(f"{keys} holds no *.pem that can be used: {expected}")
    return checks


def _contents(signature: bytes) -> tuple[set[str], list[bytes]]:
    """Return (names of the files it covers, certificates as DER) of a signature that no one has checked yet.

    Whatever this and the library could read in two ways is refused. Raises ValueError and others.
    """

    def fields(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        named = dict(pairs)
        if len(named) < len(pairs) or any("_" in name for name in named):  # the library takes cert_chain as certChain
            raise ValueError
        return named

    def decoded(text: str) -> bytes:
        content = base64.b64decode(text, validate=True)
        if base64.b64encode(content).decode() != text:
            raise ValueError
        return content

    parsed = json.loads(signature, object_pairs_hook=fields)
    material = parsed["verificationMaterial"]
    if ("publicKey" in material) == ("x509CertificateChain" in material):
        raise ValueError
    chain = material["x509CertificateChain"]["certificates"] if "x509CertificateChain" in material else []
    statement = json.loads(decoded(parsed["dsseEnvelope"]["payload"]))
    names = {each["name"] for each in statement["predicate"]["resources"]}
    return names, [decoded(each["rawBytes"]) for each in chain]


def _fault_of(certificates: list[Any]) -> str:
    """Return why the first certificate that is not valid today, or is for other uses, cannot be used; '' if all can.

    The library checks neither: without this a web server's certificate by the same issuer could sign.
    """
    from cryptography.x509 import ExtendedKeyUsage, ExtensionNotFound
    from cryptography.x509.oid import ExtendedKeyUsageOID as Use

    now = datetime.now(timezone.utc)
    for each in certificates:
        with suppress(ExtensionNotFound):
            uses = each.extensions.get_extension_for_class(ExtendedKeyUsage).value
            if not {Use.CODE_SIGNING, Use.ANY_EXTENDED_KEY_USAGE}.intersection(uses):
                return f"has a certificate of {each.subject.rfc4514_string()[:80]!r} for other uses than code signing"
        if not each.not_valid_before_utc <= now <= each.not_valid_after_utc:
            return (
                f"has a certificate of {each.subject.rfc4514_string()[:80]!r} that is valid from "
                f"{each.not_valid_before_utc:%Y-%m-%d} to {each.not_valid_after_utc:%Y-%m-%d}"
            )
    return ""


@contextmanager
def _copy(bundle: Bundle) -> Iterator[Path]:
    """Give a private folder with the bundle's files, and nothing else, whose hashes were compared."""
    with tempfile.TemporaryDirectory(prefix="rlservo-signature-") as name:
        folder = Path(name) / "signed" / bundle.contract.name  # which may be that of the signature
        folder.mkdir(parents=True)
        for file in (SUMS_FILE, *bundle.sums):
            with bundle.verified_copy(file) as copy:
                shutil.copyfile(copy, folder / file)
        yield folder
