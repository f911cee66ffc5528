"""The base of every service: life cycle, messages, sessions, overload and priority."""
