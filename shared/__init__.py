"""Code that the services share: messages, codec, bus, service loop, phones, FAPs."""
