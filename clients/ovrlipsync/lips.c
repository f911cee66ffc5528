#include "lips.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "face.h"

#define PI 3.14159265358979323846

enum { FRAMES = SEGMENTER_FRAMES_PER_ENCODER_FRAME, MAX_RECENT = SEGMENTER_MAX_RECENT };

/* Resampling to 16 kHz; front_end/resample.py has the formula. */
typedef struct {
  int up, down, half, num_phases;
  float *table; /* rows (num_phases + 1, 2 * half) of the filter */
  float *known; /* (2 * half + LIPS_MAX_CHUNK + down / up + 2,) samples */
  int num_known;
  int64_t first, num_out; /* number of the first known sample, and of the next output */
} Resampler;

struct Lips {
  int rate_hz;
  int64_t num_in, num_samples; /* at the rate of the input, and at 16 kHz */
  Resampler resampler;
  float slice[SLICE_SAMPLES];
  int num_in_slice;
  float sound[MEL_WINDOW_SAMPLES]; /* of the next window */
  int num_sound;
  int num_mel_frames; /* of the next encoder frame */
  int num_frames;
  AudioEncoder encoder;
  LipPredictor predictor;
  float recent[MAX_RECENT][NUM_FEATURES]; /* the encoder frames before speech */
  int num_recent;
  double evidence; /* of speech */
  int num_improbable;
  bool is_speech, is_speaking; /* of the detector, and of the face */
  Face face;
  int next_frame;
  float weights[LIPS_NUM_VISEMES];
};

static int gcd(int a, int b) { return b ? gcd(b, a % b) : a; }

static double sinc(double x) { return x == 0.0 ? 1.0 : sin(PI * x) / (PI * x); }

/* Return the modified Bessel function of order 0, by its power series. */
static double bessel(double x) {
  double sum = 1.0, term = 1.0;
  for (int k = 1; term > 1e-12 * sum; k++) {
    term *= (x / 2.0 / k) * (x / 2.0 / k);
    sum += term;
  }
  return sum;
}

static bool resampler_init(Resampler *r, int rate_hz) {
  const int common = gcd(RESAMPLE_SAMPLE_RATE_HZ, rate_hz);
  const double lower = fmin(1.0, (double)RESAMPLE_SAMPLE_RATE_HZ / rate_hz);
  r->up = RESAMPLE_SAMPLE_RATE_HZ / common;
  r->down = rate_hz / common;
  r->half = (int)ceil(RESAMPLE_HALF_WIDTH / lower);
  r->num_phases = r->up < RESAMPLE_MAX_PHASES ? r->up : RESAMPLE_MAX_PHASES;
  r->table = malloc(sizeof(float) * (r->num_phases + 1) * 2 * r->half);
  r->known = calloc(2 * r->half + LIPS_MAX_CHUNK + r->down / r->up + 2, sizeof(float));
  if (!r->table || !r->known) return false;
  for (int phase = 0; phase <= r->num_phases; phase++) {
    float *row = r->table + phase * 2 * r->half;
    double sum = 0.0;
    for (int pass = 0; pass < 2; pass++) {
      for (int tap = 0; tap < 2 * r->half; tap++) {
        const double time = (double)phase / r->num_phases - (tap + 1 - r->half), ratio = time / r->half;
        const double weight = sinc(lower * RESAMPLE_CUTOFF * time) * bessel(RESAMPLE_KAISER_BETA * sqrt(fmax(0.0, 1.0 - ratio * ratio)));
        if (pass == 0) sum += weight;
        else row[tap] = (float)(weight / sum);
      }
    }
  }
  return true;
}

static void resampler_reset(Resampler *r) {
  r->num_known = r->half;
  memset(r->known, 0, r->half * sizeof(float));
  r->first = -r->half;
  r->num_out = 0;
}

static void process_sample(Lips *lips, float sample);

static void resample(Lips *lips, const float *samples, int num_samples) {
  Resampler *r = &lips->resampler;
  if (r->up == r->down) {
    for (int i = 0; i < num_samples; i++) process_sample(lips, samples[i]);
    return;
  }
  memcpy(r->known + r->num_known, samples, num_samples * sizeof(float));
  r->num_known += num_samples;
  for (; (r->num_out * r->down) / r->up + r->half < r->first + r->num_known; r->num_out++) {
    const int64_t position = r->num_out * r->down, phase = position % r->up * r->num_phases;
    const float *filter = r->table + phase / r->up * 2 * r->half, *following = filter + 2 * r->half;
    const double rest = (double)(phase % r->up) / r->up; /* 0 unless the table has fewer phases than the rate */
    const float *known = r->known + (position / r->up - r->half + 1 - r->first);
    double total = 0.0;
    for (int tap = 0; tap < 2 * r->half; tap++) total += (filter[tap] + rest * (following[tap] - filter[tap])) * known[tap];
    process_sample(lips, (float)total);
  }
  int64_t drop = (r->num_out * r->down) / r->up - r->half + 1 - r->first;
  if (drop > r->num_known) drop = r->num_known;
  if (drop <= 0) return;
  r->num_known -= (int)drop;
  r->first += drop;
  memmove(r->known, r->known + drop, r->num_known * sizeof(float));
}

static double whole_samples(double time_s) { return round(time_s * MEDIA_RATE_HZ) / MEDIA_RATE_HZ; }

static void change_speech(Lips *lips, bool is_active, int frame) {
  lips->is_speaking = is_active;
  const double time_s = frame * SEGMENTER_HOP_S + (SEGMENTER_WINDOW_S - SEGMENTER_HOP_S) / 2.0;
  face_change_speech(&lips->face, whole_samples(time_s), is_active);
}

static void predict(Lips *lips, const float *features, int newest_frame) {
  const double known_s = newest_frame * SEGMENTER_HOP_S + SEGMENTER_WINDOW_S;
  LipPositions frame = lip_predictor_process(&lips->predictor, known_s, features);
  frame.time_s = whole_samples(frame.time_s);
  frame.delay_s = whole_samples(frame.delay_s);
  if (frame.time_s >= 0.0) face_add_lips(&lips->face, &frame);
}

static void start_speech(Lips *lips) {
  const int oldest = lips->num_frames - FRAMES * lips->num_recent;
  int first = lips->num_frames - SEGMENTER_PRE_ROLL_FRAMES;
  if (first < oldest) first = oldest;
  while (first % FRAMES != SEGMENTER_FIRST_FRAME_PARITY) first++;
  if (lips->num_frames - first < FRAMES) return;
  change_speech(lips, true, first);
  memset(&lips->predictor, 0, sizeof lips->predictor);
  int newest = lips->num_frames - 1 - FRAMES * (lips->num_recent - 1);
  for (int i = 0; i < lips->num_recent; i++, newest += FRAMES) {
    if (newest >= first + SEGMENTER_RIGHT_CONTEXT_FRAMES) predict(lips, lips->recent[i], newest);
  }
  lips->num_recent = 0;
}

/* Detect speech; speech_segmenter.py and vad.py have the rules. */
static void process_encoder_frame(Lips *lips) {
  const double probability = lips->encoder.voice;
  if (!lips->is_speaking) {
    if (lips->num_recent == MAX_RECENT) memmove(lips->recent[0], lips->recent[1], --lips->num_recent * sizeof lips->recent[0]);
    memcpy(lips->recent[lips->num_recent++], lips->encoder.features, sizeof lips->recent[0]);
  }
  lips->num_improbable = probability >= VAD_IMPROBABLE ? 0 : lips->num_improbable + 1;
  if (lips->is_speech) lips->is_speech = lips->num_improbable < VAD_STOP_ENCODER_FRAMES;
  else {
    lips->evidence = fmax(0.0, lips->evidence + probability - VAD_NO_EVIDENCE);
    lips->is_speech = lips->evidence >= VAD_ENOUGH;
    if (lips->is_speech) lips->evidence = 0.0;
  }
  if (lips->is_speaking && !lips->is_speech) change_speech(lips, false, lips->num_frames);
  else if (lips->is_speaking) predict(lips, lips->encoder.features, lips->num_frames - 1);
  else if (lips->is_speech) start_speech(lips);
}

/* Add the sound of the current slice to the windows of the encoder. */
static void analyze_slice(Lips *lips) {
  for (int i = 0; i < SLICE_SAMPLES; i++) {
    lips->sound[lips->num_sound++] = lips->slice[i];
    if (lips->num_sound < MEL_WINDOW_SAMPLES) continue;
    log_mel(lips->sound, lips->encoder.features + lips->num_mel_frames++ * MEL_NUM_MELS);
    lips->num_sound -= MEL_HOP_SAMPLES;
    memmove(lips->sound, lips->sound + MEL_HOP_SAMPLES, lips->num_sound * sizeof(float));
    if (lips->num_mel_frames < FRAMES) continue;
    lips->num_mel_frames = 0;
    lips->num_frames += FRAMES;
    encoder_process(&lips->encoder);
    process_encoder_frame(lips);
  }
}

static double media_time_s(const Lips *lips) { return (double)lips->num_samples / MEDIA_RATE_HZ; }

/* Process a sample at 16 kHz. After 20 ms, compute the faces that are due. */
static void process_sample(Lips *lips, float sample) {
  lips->slice[lips->num_in_slice++] = sample;
  if (lips->num_in_slice < SLICE_SAMPLES) return;
  double power = 0.0;
  for (int i = 0; i < SLICE_SAMPLES; i++) power += (double)lips->slice[i] * lips->slice[i];
  lips->num_in_slice = 0;
  analyze_slice(lips);
  lips->num_samples += SLICE_SAMPLES;
  const double level_db = fmax(STREAM_SILENT_DB, 10.0 * log10(power / SLICE_SAMPLES + 1e-12));
  face_add_level(&lips->face, media_time_s(lips), level_db);
  const int last = (int)floor((media_time_s(lips) - DELAY_S) * FRAME_RATE_HZ + FRAME_ROUNDING);
  for (; lips->next_frame <= last; lips->next_frame++) {
    face_visemes(&lips->face, (double)lips->next_frame / FRAME_RATE_HZ, lips->weights);
  }
}

void lips_init(void) { encoder_init_tables(); }

Lips *lips_create(int rate_hz) {
  Lips *lips = calloc(1, sizeof *lips);
  if (!lips) return NULL;
  lips->rate_hz = rate_hz;
  if (!resampler_init(&lips->resampler, rate_hz)) {
    lips_destroy(lips);
    return NULL;
  }
  lips_reset(lips);
  return lips;
}

void lips_destroy(Lips *lips) {
  free(lips->resampler.table);
  free(lips->resampler.known);
  free(lips);
}

void lips_reset(Lips *lips) {
  const Lips new = {.rate_hz = lips->rate_hz, .resampler = lips->resampler, .weights = {1.0f}};
  *lips = new;
  resampler_reset(&lips->resampler);
  face_init(&lips->face);
}

void lips_push(Lips *lips, const float *samples, int num_samples) {
  lips->num_in += num_samples;
  resample(lips, samples, num_samples);
}

double lips_newest(const Lips *lips, float *weights) {
  memcpy(weights, lips->weights, sizeof lips->weights);
  const double newest_s = (lips->next_frame - 1.0) / FRAME_RATE_HZ;
  return (double)lips->num_in / lips->rate_hz - fmax(newest_s, 0.0);
}

float lips_laughter(const Lips *lips) { return (float)fmin(fmax(lips->encoder.laughter, 0.0), 1.0); }
