"""The synthesizer service: turns phones and lip frames into FAP frames."""
