"""The validity of the gateway's certificate."""

import datetime
from pathlib import Path

import pytest

from kouxing.services.gateway.web.certificate import (
    create_self_signed,
    find_validity_problem,
    load_tls_context,
)

CREATED = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)


@pytest.mark.parametrize(
    ("age_days", "is_valid"), [(0, True), (395, True), (400, False), (-2, False)]
)
def test_explains_a_certificate_that_is_not_valid_at_this_time(
    age_days: int, is_valid: bool
) -> None:
    now = CREATED + datetime.timedelta(days=age_days)
    problem = find_validity_problem(create_self_signed(["localhost"], CREATED), now)
    assert (not problem) == is_valid
    assert is_valid or f"says {now:%Y-%m-%d}" in problem


def test_serves_a_trusted_certificate_whose_validity_it_cannot_read(tmp_path: Path) -> None:
    pem = create_self_signed(["localhost"], CREATED)
    certificate = tmp_path / "trusted.pem"
    certificate.write_bytes(pem.replace(b" CERTIFICATE-", b" TRUSTED CERTIFICATE-"))
    load_tls_context(certificate, [])
