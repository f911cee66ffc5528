"""The synthesizer service: phones and lip frames in, FAP frames out."""
