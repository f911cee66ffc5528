"""The face in other programs: avatars that speak VMC, Live Link Face, OSC or VTube Studio's API."""
