"""Values about lips that services and clients share."""

DEFAULT_LIP_MODEL = "learnt"
MAX_MOUTH_PROFILE_BYTES = 64 * 1024
