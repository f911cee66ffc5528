"""Control: sessions, placement, health and speech events."""
