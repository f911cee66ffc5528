import numpy as np

from kouxing.services.recognizer.front_end.features import NUM_STATIC, LiveMean, with_differences


def test_differences_of_a_line_and_a_parabola() -> None:
    """HTK book, eq. 5.16: the regression's slope is exact for a line."""
    time = np.arange(40, dtype=np.float32)
    for half_width in (1, 2):
        line = np.repeat((3 * time)[:, None], NUM_STATIC, axis=1)
        inner = with_differences(line, half_width)[2 * half_width : -2 * half_width]
        np.testing.assert_allclose(inner[:, NUM_STATIC : 2 * NUM_STATIC], 3.0, rtol=1e-5)
        np.testing.assert_allclose(inner[:, 2 * NUM_STATIC :], 0.0, atol=1e-4)
        parabola = np.repeat((time**2)[:, None], NUM_STATIC, axis=1)
        inner = with_differences(parabola, half_width)[2 * half_width : -2 * half_width]
        np.testing.assert_allclose(inner[:, 2 * NUM_STATIC :], 2.0, rtol=1e-3)


def test_live_mean_adapts_from_the_prior_to_the_speaker() -> None:
    rng = np.random.default_rng(0)
    speaker = rng.normal(5, 1, NUM_STATIC)
    static = speaker + rng.normal(0, 1, (3000, NUM_STATIC))
    features = np.concatenate([static, rng.normal(size=(3000, 26))], axis=1).astype(np.float32)
    mean = LiveMean(np.zeros(NUM_STATIC, np.float32))
    normalized = mean.normalize(features)
    assert normalized[0, 1:NUM_STATIC].mean() > 3  # the prior dominates
    assert np.abs(normalized[-1000:, :NUM_STATIC].mean(axis=0)).max() < 0.6
    np.testing.assert_array_equal(normalized[:, NUM_STATIC:], features[:, NUM_STATIC:])
    # the mean persists until reset
    assert abs(mean.normalize(features[:50])[:, 1:NUM_STATIC].mean()) < 1
    mean.reset()
    np.testing.assert_array_equal(mean.normalize(features), normalized)
