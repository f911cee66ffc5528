"""What the trainings of the networks share: Whisper's encoder, labels, augmentation, export."""
