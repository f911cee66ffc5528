"""Process that learns a mouth profile from a landmark file on standard input; writes JSON."""

import base64
import json
import sys

from kouxing.shared.errors import USER_ERROR, UserError


def main() -> None:
    """Learn the profile; raise ``UserError`` if too little speech shows the lips."""
    # Imported here, so that the gateway itself does not load the models.
    from kouxing.services.mouth_profiles.landmark_file import parse_landmark_file  # noqa: PLC0415
    from kouxing.services.mouth_profiles.learning import learn_mouth_profile  # noqa: PLC0415

    learned = learn_mouth_profile([parse_landmark_file(sys.stdin.buffer.read())])
    profile = base64.b64encode(learned.content).decode()
    json.dump({"mouth_profile": profile, **learned.figures()}, sys.stdout)


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        print(error, file=sys.stderr)
        sys.exit(USER_ERROR)
