/* The small ear: features, voice and laughter of 20 ms of sound. services/recognizer has the formulas. */
#ifndef EAR_H
#define EAR_H

#include "lips_model.h"

enum {
  NUM_FEATURES = SEGMENTER_FRAMES_PER_POSITION * MEL_NUM_MELS + EAR_NUM_FEATURES,
  EAR_WIDTH = EAR_ENTRY_INTEGERS_SIZE_0,
  NUM_MOUTH_FAPS = LEARNT_NUM_MOUTH_FAPS,
  LIP_WIDTH = LIPS_ENTRY_SIZE_1
};

typedef struct {
  float state[2 * EAR_WIDTH];
  float features[NUM_FEATURES]; /* two log-mel frames and the ear's features, at the newest position */
  double voice;                 /* probability of speech or singing */
  double laughter;              /* evidence */
} Ear;

typedef struct {
  double time_s, delay_s;
  double faps[NUM_MOUTH_FAPS];
  double closure; /* probability */
} LipFrame;

typedef struct {
  float state[LIP_WIDTH];
} LipPredictor;

/* Compute the tables of log_mel; call it once, in one thread. */
void ear_init_tables(void);
/* Compute log-mel bands (MEL_NUM_MELS,) of a window (MEL_WINDOW_SAMPLES,). */
void log_mel(const float *window, float *bands);
/* Process the next position, whose log-mel frames are at the start of the features. */
void ear_process(Ear *ear);
/* Return the lip frame that follows from the features of a position. */
LipFrame lip_predictor_process(LipPredictor *predictor, double known_s, const float *features);

#endif
