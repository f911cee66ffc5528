"""The messages between browsers and the gateway; ``proto/GATEWAY.md`` specifies them."""
