/* The audio encoder: features, voice and laughter of 20 ms of sound. services/recognizer has the formulas.
   onnxruntime is not used: its library has 35 MB. This library, including the model, has 3.6 MB. */
#ifndef ENCODER_H
#define ENCODER_H

#include "lips_model.h"

enum {
  NUM_FEATURES = SEGMENTER_FRAMES_PER_ENCODER_FRAME * MEL_NUM_MELS + ENCODER_NUM_FEATURES,
  ENCODER_WIDTH = ENCODER_ENTRY_INTEGERS_SIZE_0,
  NUM_MOUTH_FAPS = LEARNED_NUM_MOUTH_FAPS,
  LIP_WIDTH = LIPS_ENTRY_SIZE_1
};

typedef struct {
  float state[2 * ENCODER_WIDTH];
  float features[NUM_FEATURES]; /* of the newest encoder frame: two log-mel frames, then its features */
  double voice;                 /* probability of speech or singing */
  double laughter;              /* evidence */
} AudioEncoder;

typedef struct {
  double time_s, delay_s;
  double faps[NUM_MOUTH_FAPS];
  double closure; /* probability */
} LipPositions;

typedef struct {
  float state[LIP_WIDTH];
} LipPredictor;

/* Compute the tables of log_mel; call it once, in one thread. */
void encoder_init_tables(void);
/* Compute log-mel bands (MEL_NUM_MELS,) of a window (MEL_WINDOW_SAMPLES,). */
void log_mel(const float *window, float *bands);
/* Process the next encoder frame, whose log-mel frames are at the start of the features. */
void encoder_process(AudioEncoder *encoder);
/* Return the lip positions that an encoder frame's features determine. */
LipPositions lip_predictor_process(LipPredictor *predictor, double known_s, const float *features);

#endif
