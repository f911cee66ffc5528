#include "encoder.h"

#include <math.h>
#include <string.h>

#define PI 3.14159265358979323846

typedef struct {
  const int8_t *integers; /* (columns, rows) */
  const float *scales, *bias;
  int columns, rows;
} Layer;

#define LAYER(NAME) \
  ((Layer){NAME##_INTEGERS, NAME##_SCALES, NAME##_BIAS, NAME##_INTEGERS_SIZE_0, NAME##_INTEGERS_SIZE_1})

enum { HALF_WINDOW = MEL_WINDOW_SAMPLES / 2, NUM_BINS = MEL_BANDS_SIZE_0, NUM_VOICES = 4 };

static double sigmoid(double x) { return 0.5 * tanh(0.5 * x) + 0.5; }

static double cosines[MEL_WINDOW_SAMPLES], sines[MEL_WINDOW_SAMPLES];

void encoder_init_tables(void) {
  for (int n = 0; n < MEL_WINDOW_SAMPLES; n++) {
    cosines[n] = cos(2.0 * PI * n / MEL_WINDOW_SAMPLES);
    sines[n] = sin(2.0 * PI * n / MEL_WINDOW_SAMPLES);
  }
}

void log_mel(const float *window, float *bands) {
  double sound[MEL_WINDOW_SAMPLES], even[HALF_WINDOW], odd[HALF_WINDOW], powers[NUM_BINS];
  for (int n = 0; n < MEL_WINDOW_SAMPLES; n++) sound[n] = MEL_HANN[n] * window[n];
  for (int n = 1; n < HALF_WINDOW; n++) { /* cosines are equal at n and -n; sines have opposite signs */
    even[n] = sound[n] + sound[MEL_WINDOW_SAMPLES - n];
    odd[n] = sound[n] - sound[MEL_WINDOW_SAMPLES - n];
  }
  for (int bin = 0; bin < NUM_BINS; bin++) {
    double real = sound[0] + (bin % 2 ? -1.0 : 1.0) * sound[HALF_WINDOW], imaginary = 0.0;
    for (int n = 1, angle = bin; n < HALF_WINDOW; n++) {
      real += even[n] * cosines[angle];
      imaginary += odd[n] * sines[angle];
      angle += bin;
      if (angle >= MEL_WINDOW_SAMPLES) angle -= MEL_WINDOW_SAMPLES;
    }
    powers[bin] = real * real + imaginary * imaginary;
  }
  for (int band = 0; band < MEL_NUM_MELS; band++) {
    double total = 0.0;
    for (int bin = MEL_EDGES[2 * band]; bin < MEL_EDGES[2 * band + 1]; bin++) {
      total += MEL_BANDS[bin * MEL_NUM_MELS + band] * powers[bin];
    }
    bands[band] = (float)((log10(fmax(total, MEL_FLOOR)) + 4.0) / 4.0);
  }
}

/* Compute a layer with weights and inputs of 8 bits. As on the server, values have 32 bits after each step. */
static void apply_layer(Layer layer, const float *inputs, float *outputs) {
  int8_t integers[ENCODER_WIDTH];
  float largest = 0.0f;
  for (int i = 0; i < layer.rows; i++) largest = fmaxf(largest, fabsf(inputs[i]));
  const float scale = fmaxf(largest * (float)ENCODER_STEP, (float)ENCODER_MIN_SCALE);
  for (int i = 0; i < layer.rows; i++) {
    const float rounded = rintf(inputs[i] / scale);
    integers[i] = (int8_t)fminf(fmaxf(rounded, -128.0f), 127.0f);
  }
  const int8_t *weights = layer.integers;
  for (int column = 0; column < layer.columns; column++, weights += layer.rows) {
    int32_t sum = 0;
    for (int i = 0; i < layer.rows; i++) sum += integers[i] * weights[i];
    const float product = (float)((double)layer.scales[column] * sum);
    outputs[column] = product * scale + layer.bias[column];
  }
}

/* Advance a gated recurrent unit (Cho et al. 2014). */
static void advance_unit(Layer from_inputs, Layer from_state, const float *inputs, float *state) {
  float x[3 * ENCODER_WIDTH], h[3 * ENCODER_WIDTH];
  apply_layer(from_inputs, inputs, x);
  apply_layer(from_state, state, h);
  for (int i = 0; i < ENCODER_WIDTH; i++) {
    const float reset = (float)(1.0 / (1.0 + exp(-(double)(x[i] + h[i]))));
    const float update = (float)(1.0 / (1.0 + exp(-(double)(x[ENCODER_WIDTH + i] + h[ENCODER_WIDTH + i]))));
    const float next = tanhf(x[2 * ENCODER_WIDTH + i] + reset * h[2 * ENCODER_WIDTH + i]);
    state[i] = next + update * (state[i] - next);
  }
}

void encoder_process(AudioEncoder *encoder) {
  float entered[ENCODER_WIDTH], outputs[ENCODER_OUTPUT_INTEGERS_SIZE_0];
  float *first = encoder->state, *second = encoder->state + ENCODER_WIDTH;
  apply_layer(LAYER(ENCODER_ENTRY), encoder->features, entered);
  for (int i = 0; i < ENCODER_WIDTH; i++) entered[i] = fmaxf(entered[i], 0.0f);
  advance_unit(LAYER(ENCODER_FIRST_IH), LAYER(ENCODER_FIRST_HH), entered, first);
  advance_unit(LAYER(ENCODER_SECOND_IH), LAYER(ENCODER_SECOND_HH), first, second);
  for (int i = 0; i < ENCODER_WIDTH; i++) entered[i] = first[i] + second[i];
  apply_layer(LAYER(ENCODER_OUTPUT), entered, outputs);
  memcpy(encoder->features + NUM_FEATURES - ENCODER_NUM_FEATURES, outputs, ENCODER_NUM_FEATURES * sizeof(float));

  const float *logits = outputs + ENCODER_NUM_FEATURES + ENCODER_NUM_PHONES;
  double total = 0.0;
  for (int voice = 0; voice < NUM_VOICES; voice++) total += exp(logits[voice]);
  encoder->voice = (float)((exp(logits[VOICE_SPEECH]) + exp(logits[VOICE_SUNG])) / total);

  enum { LAUGHTER = 2 }; /* a column of the readout */
  double laughter = TRAITS_BIAS[LAUGHTER];
  for (int i = 0; i < 2 * ENCODER_WIDTH; i++) laughter += (double)encoder->state[i] * TRAITS_WEIGHTS[i * TRAITS_NUM_TRAITS + LAUGHTER];
  encoder->laughter += TRAITS_EVIDENCE_FRACTION * (laughter - encoder->laughter);
}

static void copy(double *out, const float *values, int size) {
  for (int i = 0; i < size; i++) out[i] = values[i];
}

/* Add the product of a vector and a matrix (rows, columns), whose rows are stride numbers apart. */
static void add_product(double *out, const double *vector, const float *matrix, int rows, int columns, int stride) {
  for (int row = 0; row < rows; row++) {
    for (int column = 0; column < columns; column++) out[column] += vector[row] * matrix[row * stride + column];
  }
}

/* Return the number of the longest delay that suits the face's. */
static int chosen_delay(void) {
  int chosen = 0;
  for (int i = 0; i < LIPS_DELAYS_SIZE_0; i++) {
    if (LIPS_DELAYS[i] + LIP_PREDICTION_ENCODER_FRAME_LAG_S <= DELAY_S + 1e-6) chosen = i;
  }
  return chosen;
}

LipPositions lip_predictor_process(LipPredictor *predictor, double known_s, const float *features) {
  enum { GATES = LIPS_STATE_BIAS_SIZE_0, ALL_OUTPUTS = LIPS_DELAYS_SIZE_0 * LIPS_NUM_OUTPUTS };
  double inputs[NUM_FEATURES], centered[NUM_FEATURES], from_input[GATES], from_state[GATES], outputs[LIPS_NUM_OUTPUTS];
  double hidden[2 * LIP_WIDTH], *state = hidden, *entered = hidden + LIP_WIDTH;
  copy(inputs, features, NUM_FEATURES);
  for (int i = 0; i < NUM_FEATURES; i++) centered[i] = inputs[i] - LIPS_FEATURE_MEAN[i];
  copy(entered, LIPS_ENTRY_BIAS, LIP_WIDTH);
  add_product(entered, centered, LIPS_ENTRY, NUM_FEATURES, LIP_WIDTH, LIP_WIDTH);
  for (int i = 0; i < LIP_WIDTH; i++) entered[i] = fmax(entered[i], 0.0);
  copy(from_input, LIPS_INPUT_BIAS, GATES);
  add_product(from_input, entered, LIPS_INPUT_WEIGHTS, LIP_WIDTH, GATES, GATES);
  copy(state, predictor->state, LIP_WIDTH);
  copy(from_state, LIPS_STATE_BIAS, GATES);
  add_product(from_state, state, LIPS_STATE_WEIGHTS, LIP_WIDTH, GATES, GATES);
  for (int i = 0; i < LIP_WIDTH; i++) {
    const double reset = sigmoid(from_input[i] + from_state[i]);
    const double update = sigmoid(from_input[LIP_WIDTH + i] + from_state[LIP_WIDTH + i]);
    const double next = tanh(from_input[2 * LIP_WIDTH + i] + reset * from_state[2 * LIP_WIDTH + i]);
    predictor->state[i] = (float)((1.0 - update) * next + update * state[i]);
  }
  copy(state, predictor->state, LIP_WIDTH);
  const int delay = chosen_delay(), first = delay * LIPS_NUM_OUTPUTS; /* column of this delay */
  copy(outputs, LIPS_OUTPUT_BIAS + first, LIPS_NUM_OUTPUTS);
  add_product(outputs, inputs, LIPS_LIP_WEIGHTS + first, NUM_FEATURES, LIPS_NUM_OUTPUTS, ALL_OUTPUTS);
  add_product(outputs, hidden, LIPS_OUTPUT_WEIGHTS + first, 2 * LIP_WIDTH, LIPS_NUM_OUTPUTS, ALL_OUTPUTS);
  LipPositions frame = {.time_s = known_s - LIPS_DELAYS[delay], .delay_s = LIPS_DELAYS[delay]};
  for (int i = 0; i < LIPS_COLUMNS_LENGTH; i++) frame.faps[LIPS_COLUMNS[i]] = (float)outputs[i];
  for (int i = 0; i < LIPS_OTHERS_LENGTH; i++) frame.faps[LIPS_OTHERS[i]] = frame.faps[LIPS_ONES[i]];
  frame.closure = sigmoid(outputs[LIPS_CLOSURE]);
  return frame;
}
