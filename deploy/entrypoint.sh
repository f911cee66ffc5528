# Starts kouxing in a container.
# numba reads compiled functions only from a writable folder. Recompiling them takes 6 s.
cp -rT /kouxing/numba "$NUMBA_CACHE_DIR"
exec kouxing "$@"
