"""Control: places sessions on workers, checks the health of services, and publishes events."""
