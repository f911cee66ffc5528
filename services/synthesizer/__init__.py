"""The synthesizer service: turns phones and lip positions into FAP frames."""
