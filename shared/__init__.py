"""What more than one service uses: messages, codec, bus, service loop, phones, FAPs."""
