"""Tests in Firefox, which ``make test-firefox`` runs."""
