# Starts kouxing in a container.
# numba reads compiled functions only where it may write; compiling them anew takes 6 s.
cp -rT /kouxing/numba "$NUMBA_CACHE_DIR"
exec kouxing "$@"
