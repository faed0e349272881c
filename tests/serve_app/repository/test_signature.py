"""Signatures: checked by hand as OpenSSF's specification says, and attacked; keys come and go while serving.

https://github.com/ossf/model-signing-spec/blob/main/spec/v1.0.md
"""

from __future__ import annotations

import asyncio
import base64
import datetime
import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bundles import write_box_policy
from command_line import rlservo, rlservo_here
from rlservo.bundle.bundle import SUMS_FILE, Bundle, load_bundle
from rlservo.errors import BundleError, BundleTamperedError, ConflictError, UsageError
from rlservo.policy.policy import Policy
from rlservo.serve_app.repository import repository
from rlservo.serve_app.repository.publication import next_version, publish
from rlservo.serve_app.repository.repository import Repository
from rlservo.serve_app.repository.signature import SIGNATURE_FILE, check_signature, sign
from rlservo.serve_app.server.settings import ServerSettings
from rlservo.serve_app.server.start_check import load_served
from rlservo.serve_app.versions.deployment_plan import ServedConfig
from rlservo.serve_app.versions.version_loader import VersionLoader
from storages import Storage

pytest.importorskip("model_signing")
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from model_signing import hashing, signing

DAY = datetime.timedelta(days=1)
Key = ec.EllipticCurvePrivateKey


def write(folder: Path, name: str, key: Key | None = None, curve: ec.EllipticCurve | None = None) -> tuple[Key, Path]:
    """Write `<name>.key`, and its public key into `keys/<name>.pem`."""
    key = key or ec.generate_private_key(curve or ec.SECP256R1())
    private = folder / f"{name}.key"
    private.write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    (folder / "keys").mkdir(exist_ok=True)
    (folder / "keys" / f"{name}.pem").write_bytes(
        key.public_key().public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)
    )
    return key, private


def certificate(
    subject: str,
    key: Key,
    issuer: str,
    by: Key,
    days: tuple[int, int],
    *,
    is_ca: bool = False,
    uses: tuple[x509.ObjectIdentifier, ...] = (),
) -> bytes:
    name = [x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, each)]) for each in (subject, issuer)]
    now = datetime.datetime.now(datetime.timezone.utc)
    unused = ("content_commitment", "key_encipherment", "data_encipherment", "key_agreement", "crl_sign")
    usage = dict.fromkeys((*unused, "encipher_only", "decipher_only"), False)
    made = (
        x509.CertificateBuilder()
        .subject_name(name[0])
        .issuer_name(name[1])
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now + days[0] * DAY)
        .not_valid_after(now + days[1] * DAY)
        .add_extension(x509.BasicConstraints(ca=is_ca, path_length=None), critical=True)
        .add_extension(x509.KeyUsage(digital_signature=not is_ca, key_cert_sign=is_ca, **usage), critical=True)
    )
    if uses:
        made = made.add_extension(x509.ExtendedKeyUsage(uses), critical=False)
    return made.sign(by, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


@pytest.fixture
def bundle(tmp_path: Path) -> Bundle:
    write_box_policy(tmp_path / "policies")
    return load_bundle(tmp_path / "policies")


def statement_of(signature: dict[str, Any]) -> dict[str, Any]:
    parsed: dict[str, Any] = json.loads(base64.b64decode(signature["dsseEnvelope"]["payload"]))
    return parsed


@pytest.mark.parametrize(
    ("curve", "digest"),
    [(ec.SECP256R1(), hashes.SHA256()), (ec.SECP384R1(), hashes.SHA384()), (ec.SECP521R1(), hashes.SHA512())],
    ids=["P-256", "P-384", "P-521"],
)
def test_a_signature_is_what_the_specification_says(
    tmp_path: Path, bundle: Bundle, curve: ec.EllipticCurve, digest: hashes.HashAlgorithm
) -> None:
    key, private = write(tmp_path, "team", curve=curve)
    before = bundle.digest
    parsed = json.loads(sign(bundle, private).read_bytes())
    envelope = parsed["dsseEnvelope"]
    payload = base64.b64decode(envelope["payload"])
    kind = b"application/vnd.in-toto+json"
    assert envelope["payloadType"].encode() == kind
    signed = b"DSSEv1 %d %s %d %s" % (len(kind), kind, len(payload), payload)
    key.public_key().verify(base64.b64decode(envelope["signatures"][0]["sig"]), signed, ec.ECDSA(digest))
    statement = statement_of(parsed)
    assert statement["predicateType"] == "https://model_signing/signature/v1.0"
    files = {file.name: hashlib.sha256(file.read_bytes()) for file in bundle.path.iterdir()}
    del files[SIGNATURE_FILE]
    assert {each["name"]: each["digest"] for each in statement["predicate"]["resources"]} == {
        name: each.hexdigest() for name, each in files.items()
    }
    root = hashlib.sha256(b"".join(files[name].digest() for name in sorted(files))).hexdigest()
    assert statement["subject"][0]["digest"] == {"sha256": root}
    assert check_signature(bundle, tmp_path / "keys") == "team.pem"
    assert load_bundle(bundle.path).digest == before


def rewritten(bundle: Bundle) -> None:
    """Change the contract and the hashes with it, as someone who can write into the folder would."""
    contract = bundle.path / "contract.json"
    contract.write_text(contract.read_text().replace('"description": ""', '"description": "faster"', 1))
    lines = [f"{hashlib.sha256((bundle.path / name).read_bytes()).hexdigest()}  {name}\n" for name in bundle.sums]
    (bundle.path / SUMS_FILE).write_text("".join(lines))


def add_a_file(bundle: Bundle) -> None:
    (bundle.path / "notes.txt").write_text("mine")
    with (bundle.path / SUMS_FILE).open("a") as sums:
        sums.write(f"{hashlib.sha256(b'mine').hexdigest()}  notes.txt\n")


def exchange(bundle: Bundle) -> None:
    """Put another policy of the same name and version, with the signature of this one."""
    signature = (bundle.path / SIGNATURE_FILE).read_bytes()
    shutil.rmtree(bundle.path.parent)
    write_box_policy(bundle.path.parent.parent, seed=5)
    (bundle.path / SIGNATURE_FILE).write_bytes(signature)


@pytest.mark.parametrize("attack", [rewritten, add_a_file, exchange])
def test_a_changed_bundle_is_not_what_was_signed(
    tmp_path: Path, bundle: Bundle, attack: Callable[[Bundle], None]
) -> None:
    _, private = write(tmp_path, "team")
    sign(bundle, private)
    attack(bundle)
    changed = load_bundle(bundle.path)
    assert changed.digest != bundle.digest
    with pytest.raises(BundleError, match=r"model\.sig, made with team\.pem, does not match these files"):
        check_signature(changed, tmp_path / "keys")


def test_a_file_that_nobody_signed_is_not_part_of_the_bundle(tmp_path: Path, bundle: Bundle) -> None:
    (bundle.path / "notes.txt").write_text("mine")
    sign(bundle, write(tmp_path, "team")[1])
    (bundle.path / "notes.txt").write_text("other")
    assert check_signature(bundle, tmp_path / "keys") == "team.pem"


def test_a_signature_that_leaves_out_the_hashes_is_refused(tmp_path: Path, bundle: Bundle) -> None:
    """The format lets the signer leave out files: then none of the others would be bound."""
    _, private = write(tmp_path, "team")
    config = hashing.Config().set_ignored_paths(paths=[SUMS_FILE, "policy.onnx", SIGNATURE_FILE])
    signing.Config().use_elliptic_key_signer(private_key=private).set_hashing_config(config).sign(
        bundle.path, bundle.path / SIGNATURE_FILE
    )
    with pytest.raises(BundleError, match=r"model\.sig, made with team\.pem, does not cover SHA256SUMS"):
        check_signature(bundle, tmp_path / "keys")


def certified(folder: Path, days: tuple[int, int]) -> tuple[Path, Path, Path]:
    """Return (key, its certificate, folder with the issuer's)."""
    (issuer, _), (leaf, private) = write(folder, "issuer"), write(folder, "leaf")
    (folder / "trusted").mkdir()
    (folder / "trusted" / "ca.pem").write_bytes(certificate("ca", issuer, "ca", issuer, (-400, 400), is_ca=True))
    (folder / "leaf.crt").write_bytes(certificate("leaf", leaf, "ca", issuer, days))
    return private, folder / "leaf.crt", folder / "trusted"


def test_an_issuer_stands_for_its_certificates_until_they_expire(tmp_path: Path, bundle: Bundle) -> None:
    private, leaf, issuers = certified(tmp_path, (-2, 2))
    sign(bundle, private, leaf)
    assert check_signature(bundle, issuers) == "ca.pem"
    (tmp_path / "old").mkdir()
    private, leaf, issuers = certified(tmp_path / "old", (-200, -100))
    with pytest.raises(BundleError, match="with none of the keys"):
        check_signature(bundle, issuers)
    write(tmp_path, "team")
    team = tmp_path / "keys" / "team.pem"
    file = sign(bundle, private, leaf)
    reason = r"has a certificate of 'CN=leaf' that is valid from \d{4}-\d\d-\d\d to"
    with pytest.raises(BundleError, match=reason):
        check_signature(bundle, issuers)
    with pytest.raises(BundleError, match=rf"with none of the keys in .* \(team\.pem\); it {reason}"):
        check_signature(bundle, team)
    # The library takes the names of protobuf as well as those of JSON.
    signature = json.loads(file.read_text())
    chain = signature["verificationMaterial"].pop("x509CertificateChain")
    rest = signature["verificationMaterial"]
    for material in (
        {"x509_certificate_chain": chain},
        {"x509_certificate_chain": chain, "publicKey": {"hint": "0" * 64}},
        {"x509CertificateChain": {"certificates": [{"raw_bytes": each["rawBytes"]} for each in chain["certificates"]]}},
    ):
        file.write_text(json.dumps({**signature, "verificationMaterial": {**rest, **material}}))
        with pytest.raises(BundleError, match="is not an OpenSSF Model Signing signature"):
            check_signature(bundle, issuers)


def test_a_certificate_for_other_uses_signs_nothing(tmp_path: Path, bundle: Bundle) -> None:
    """Such as that of a web server, which may be on many machines (RFC 5280, 4.2.1.12)."""
    (issuer, _), (leaf, private) = write(tmp_path, "issuer"), write(tmp_path, "leaf")
    use = x509.ExtendedKeyUsageOID
    chain, folder = tmp_path / "chain", tmp_path / "trusted"
    folder.mkdir()
    (folder / "ca.pem").write_bytes(certificate("ca", issuer, "ca", issuer, (-9, 9), is_ca=True))
    for given in ((use.CODE_SIGNING,), (use.SERVER_AUTH, use.ANY_EXTENDED_KEY_USAGE)):
        chain.write_bytes(certificate("leaf", leaf, "ca", issuer, (-2, 2), uses=given))
        sign(bundle, private, chain)
        assert check_signature(bundle, folder) == "ca.pem"
    web = certificate("web", leaf, "ca", issuer, (-2, 2), uses=(use.SERVER_AUTH, use.CLIENT_AUTH))
    chain.write_bytes(web)
    sign(bundle, private, chain)
    with pytest.raises(BundleError, match=r"has a certificate of 'CN=web' for other uses than code signing"):
        check_signature(bundle, folder)
    between, _ = write(tmp_path, "between")  # an issuer of web servers' certificates issues no other
    chain.write_bytes(
        certificate("leaf", leaf, "between", between, (-2, 2))
        + certificate("between", between, "ca", issuer, (-2, 2), is_ca=True, uses=(use.SERVER_AUTH,))
    )
    sign(bundle, private, chain)
    with pytest.raises(BundleError, match=r"has a certificate of 'CN=between' for other uses"):
        check_signature(bundle, folder)


@pytest.mark.parametrize("content", [b"", b"{}", b"[]", b"\xff", b"[" * 100_000, b'{"verificationMaterial": 3}'])
def test_what_is_no_signature_is_said(tmp_path: Path, bundle: Bundle, content: bytes) -> None:
    write(tmp_path, "team")
    (bundle.path / SIGNATURE_FILE).write_bytes(content)
    with pytest.raises(BundleError, match="is not an OpenSSF Model Signing signature"):
        check_signature(bundle, tmp_path / "keys")


def test_keys_that_cannot_be_used_are_named(tmp_path: Path, bundle: Bundle) -> None:
    key, private = write(tmp_path, "team")
    keys = tmp_path / "keys"
    with pytest.raises(BundleError, match=r"has no model\.sig"):
        check_signature(bundle, keys)
    shutil.copy(private, keys / "mine.pem")
    with pytest.raises(UsageError, match=r"mine\.pem holds a private key"):
        check_signature(bundle, keys)
    (keys / "mine.pem").write_text("-----BEGIN PUBLIC KEY-----\nAAAA\n-----END PUBLIC KEY-----\n")
    with pytest.raises(UsageError, match=r"mine\.pem holds no key"):
        check_signature(bundle, keys)
    unknown = ed25519.Ed25519PrivateKey.generate().public_key()
    der = unknown.public_bytes(serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo)
    text = base64.b64encode(der.replace(b"\x2b\x65\x70", b"\x2b\x65\x7f")).decode()  # an algorithm of the future
    (keys / "mine.pem").write_text(f"-----BEGIN PUBLIC KEY-----\n{text}\n-----END PUBLIC KEY-----\n")
    with pytest.raises(UsageError, match=r"mine\.pem holds no key \(Unknown key type"):
        check_signature(bundle, keys)
    for folder in (tmp_path / "none", tmp_path / "policies"):
        with pytest.raises(UsageError, match=r"expected public elliptic keys"):
            ServerSettings(require_signature=str(folder)) and Repository([bundle.path], keys=folder)
    other = rsa.generate_private_key(65537, 2048)
    private.write_bytes(
        other.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    with pytest.raises(UsageError, match=r"team\.key cannot sign: expected an elliptic private key"):
        sign(bundle, private)
    assert not (bundle.path / SIGNATURE_FILE).exists()
    assert key


def test_a_key_in_a_file_of_another_name_is_warned_of(
    tmp_path: Path, bundle: Bundle, caplog: pytest.LogCaptureFixture
) -> None:
    (_, private), _ = write(tmp_path, "team"), write(tmp_path, "other")
    sign(bundle, private)
    (tmp_path / "keys" / "team.pem").rename(tmp_path / "keys" / "team.pub")
    with pytest.raises(BundleError, match="with none of the keys"):
        check_signature(bundle, tmp_path / "keys")
    assert [one for one in caplog.messages if "not *.pem, so not used as keys: team.pub" in one]


def test_keys_are_changed_while_serving(tmp_path: Path) -> None:
    """Each load reads the keys: a new one is trusted at once, a removed one no more; what is loaded stays."""
    root, privates = tmp_path / "policies", {name: write(tmp_path, name)[1] for name in ("old", "new")}
    for version, name in enumerate(("old", "new", "new", "old"), start=1):
        write_box_policy(root, version=str(version), seed=version)
        sign(load_bundle(root / "ur5" / str(version)), privates[name])
    new = (tmp_path / "keys" / "new.pem").rename(tmp_path / "new.pem")
    loader = VersionLoader(Repository([root], keys=tmp_path / "keys"))
    digests = {str(v): load_bundle(root / "ur5" / str(v)).digest for v in range(1, 5)}

    async def load(version: str) -> str:
        return (await loader.load(("ur5", version, digests[version]))).contract.version

    async def rotate() -> None:
        assert await load("1") == "1"
        with pytest.raises(BundleError, match=r"with none of the keys in .* \(old\.pem\)"):
            await load("2")
        shutil.copy(new, tmp_path / "keys")
        assert await load("2") == "2"
        (tmp_path / "keys" / "old.pem").unlink()
        assert [await load(version) for version in "13"] == ["1", "3"]
        with pytest.raises(BundleError, match=r"with none of the keys in .* \(new\.pem\)"):
            await load("4")

    asyncio.run(rotate())


def test_a_signed_bundle_that_is_there_only_for_the_check_helps_no_other(
    tmp_path: Path, bundle: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Someone who can write into the folder exchanges the bundle before the signature check and again after it."""
    sign(bundle, write(tmp_path, "team")[1])
    signed, evil = bundle.path.rename(tmp_path / "signed"), write_box_policy(tmp_path / "evil", seed=5)
    bundle.path.symlink_to(evil)
    digest = load_bundle(evil).digest

    def exchanging(there: Path, call: Callable[..., Any]) -> Callable[..., Any]:
        def exchanged(*given: Any) -> Any:
            bundle.path.unlink()
            bundle.path.symlink_to(there)
            return call(*given)

        return exchanged

    monkeypatch.setattr(repository, "load_bundle", exchanging(signed, load_bundle))
    loader = VersionLoader(
        Repository([tmp_path / "policies"], keys=tmp_path / "keys"), load=exchanging(evil, Policy.load)
    )
    with pytest.raises(BundleTamperedError, match=r"is not the bundle that was accepted as version 1 of 'ur5'"):
        asyncio.run(loader.load(("ur5", "1", digest)))


def test_a_signature_is_published_fetched_and_replaced(tmp_path: Path, bundle: Bundle, storage: Storage) -> None:
    (_, old), (_, new) = write(tmp_path, "old"), write(tmp_path, "new")
    settings = ServerSettings(cache=str(tmp_path / "cache"), require_signature=str(tmp_path / "keys"))

    def serve() -> str:
        store = load_served([storage.uri], ServedConfig(), settings)
        try:
            return store.default("ur5")
        finally:
            store.close()

    publish(bundle, storage.uri)
    with pytest.raises(BundleError, match=r"has no model\.sig"):
        serve()
    sign(bundle, old)
    publish(bundle, storage.uri)  # only its signature
    assert serve() == "1"
    with pytest.raises(ConflictError, match="with this signature"):
        publish(bundle, storage.uri)
    (tmp_path / "keys" / "old.pem").unlink()
    with pytest.raises(BundleError, match="with none of the keys"):
        serve()
    sign(bundle, new)
    publish(bundle, storage.uri)
    assert serve() == "1"  # although the cache has the other one
    (tmp_path / "keys" / "new.pem").rename(tmp_path / "keys" / "renamed.pem")
    storage.go_away()
    fetched = Repository([storage.uri], cache=tmp_path / "cache", keys=tmp_path / "keys")
    with fetched.fetch("ur5", "1", bundle.digest) as folder:
        assert check_signature(load_bundle(folder), tmp_path / "keys") == "renamed.pem"


def test_what_is_no_signature_is_refused_before_anything_is_published(bundle: Bundle, storage: Storage) -> None:
    (bundle.path / SIGNATURE_FILE).write_bytes(b"{}")
    with pytest.raises(BundleError, match="is not an OpenSSF Model Signing signature"):
        publish(bundle, storage.uri)
    assert next_version(storage.uri, "ur5") == "1"


def test_links_in_a_bundle_neither_overwrite_nor_publish_a_file(tmp_path: Path, bundle: Bundle) -> None:
    """A bundle may come from anyone: signing it must not write to, and publishing it not read, what a link names."""
    mine = tmp_path / "mine"
    mine.write_text("secret")
    for name in (".model.sig.new", SIGNATURE_FILE):
        (bundle.path / name).symlink_to(mine)
    with pytest.raises(BundleError, match=r"model\.sig is not an OpenSSF"):
        publish(bundle, str(tmp_path / "published"))
    assert not list((tmp_path / "published").rglob(SIGNATURE_FILE))
    file = sign(bundle, write(tmp_path, "team")[1])
    assert mine.read_text() == "secret" and not file.is_symlink()
    assert check_signature(bundle, tmp_path / "keys") == "team.pem"


def test_a_policy_named_as_the_signature_is_signed(tmp_path: Path) -> None:
    bundle = load_bundle(write_box_policy(tmp_path / "policies", name=SIGNATURE_FILE))
    sign(bundle, write(tmp_path, "team")[1])
    assert check_signature(bundle, tmp_path / "keys") == "team.pem"


def test_an_interrupted_publication_is_completed_with_the_signature_made_since(
    tmp_path: Path, bundle: Bundle, storage: Storage
) -> None:
    _, private = write(tmp_path, "team")
    for place in (str(tmp_path / "published"), storage.uri):
        (bundle.path / SIGNATURE_FILE).unlink(missing_ok=True)
        for _ in range(2):  # first without a signature, then with another one
            publish(bundle, place)
            if place == storage.uri:
                storage.change("DELETE", "index.json")
            else:
                (tmp_path / "published" / "index.json").unlink()
            sign(bundle, private)
        publish(bundle, place)
        with pytest.raises(ConflictError, match="with this signature"):
            publish(bundle, place)


def test_a_good_signature_of_another_place_counts(tmp_path: Path, bundle: Bundle, storage: Storage) -> None:
    """Two places have the bundle; the first has no signature, then one by a key that nobody trusts."""
    (_, trusted), (_, other) = write(tmp_path, "trusted"), write(tmp_path, "other")
    (tmp_path / "keys" / "other.pem").unlink()
    first, second = f"{storage.uri}/first", f"{storage.uri}/second"
    publish(bundle, first)
    sign(bundle, trusted)
    publish(bundle, second)
    for is_signed in (False, True):
        if is_signed:
            sign(bundle, other)
            publish(bundle, first)
        fetched = Repository([first, second], cache=tmp_path / f"cache{is_signed}", keys=tmp_path / "keys")
        with fetched.fetch("ur5", "1", bundle.digest) as folder:
            assert check_signature(load_bundle(folder), tmp_path / "keys") == "trusted.pem"


def test_the_commands_sign_and_require(tmp_path: Path, bundle: Bundle) -> None:
    (_, private), keys = write(tmp_path, "team"), tmp_path / "keys"
    served = ("serve", tmp_path / "policies", "--port", 0, "--require-signature", keys)
    refused = rlservo(*served)
    assert refused.returncode == 1 and "has no model.sig" in refused.stderr
    signed = rlservo_here("sign", tmp_path / "policies", "--key", private)
    assert signed.returncode == 0 and str(bundle.path / SIGNATURE_FILE) in signed.stdout
    (keys / "team.pem").unlink()
    refused = rlservo(*served)
    assert refused.returncode == 2 and "holds no *.pem" in refused.stderr
