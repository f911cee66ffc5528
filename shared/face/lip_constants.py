"""Lip-model constants for services and clients."""

import re

DEFAULT_LIP_MODEL = "learned"
LIP_MODEL_NAME = re.compile("[a-z0-9-]{1,64}")
MAX_MOUTH_PROFILE_BYTES = 64 * 1024
