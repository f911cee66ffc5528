"""Lip-model constants for services and clients."""

DEFAULT_LIP_MODEL = "learned"
MAX_MOUTH_PROFILE_BYTES = 64 * 1024
