"""The page over TLS: one token allows driving, the other only viewing."""

import datetime
from pathlib import Path

import pytest

from gigabrain_zenoh.testing.waiting import until
from tests.system.fake_page import Fake, serving
from tests.system.page import OPERATOR, VIEWER, browser, needs_browser

pytestmark = needs_browser


def make_certificate(folder: Path) -> dict[str, str]:
    """Return the settings of a self-signed certificate in `folder`."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "127.0.0.1")])
    now = datetime.datetime.now(datetime.UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .sign(key, hashes.SHA256())
    )
    plain = serialization.NoEncryption()
    form = serialization.PrivateFormat.PKCS8
    pem = serialization.Encoding.PEM
    (folder / "page.crt").write_bytes(certificate.public_bytes(pem))
    (folder / "page.key").write_bytes(key.private_bytes(pem, form, plain))
    return {"certificate": str(folder / "page.crt"), "certificate_key": str(folder / "page.key")}


async def test_over_tls_one_token_allows_driving_and_the_other_only_viewing(
    tmp_path: Path,
) -> None:
    pytest.importorskip("cryptography")
    fake = Fake(tmp_path, **make_certificate(tmp_path))
    async with serving(fake), browser(fake, tmp_path / "profile") as chromium:
        page = await chromium.open()
        assert page.url.startswith("https://")
        await page.wait_for_selector("#gate[data-mode=enabled]")
        await page.keyboard.down("w")
        await until(lambda: fake.steered and fake.steered[-1].linear_x > 0.1, "steered")
        await page.keyboard.up("w")
        await until(lambda: fake.steered[-1].linear_x == 0.0, "released")
        viewer = await chromium.open(VIEWER)
        assert await viewer.is_disabled("#estop")
        count = len(fake.steered)
        await viewer.keyboard.press("w")
        stranger = await chromium.open(VIEWER)
        await stranger.evaluate("sessionStorage.clear()")
        await stranger.goto(f"{fake.origin}/#a-wrong-token-of-some-length")
        await stranger.wait_for_selector("#login[open]")
        await stranger.fill("#token", OPERATOR)
        await stranger.click("#login button")
        await stranger.wait_for_selector("#link.live")
        assert len(fake.steered) == count
