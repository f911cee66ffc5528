"""The HTTP server: files of the page, access, certificate and limits."""
