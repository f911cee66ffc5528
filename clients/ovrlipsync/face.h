/* Mouths from lip positions; services/synthesizer has the rules. */
#ifndef FACE_H
#define FACE_H

#include <stdbool.h>

#include "encoder.h"

enum { MAX_KNOTS = 64, MAX_QUEUE = 32, MAX_LEVELS = 64, MAX_CHANGES = 16, NUM_SHAPES = SHAPES_OCULUS_GRAM_SIZE_0 };

typedef struct {
  double value[NUM_MOUTH_FAPS], velocity[NUM_MOUTH_FAPS];
} Mouth;

typedef struct {
  double time_s;
  Mouth mouth;
} Knot;

/* A trajectory from lip positions; it starts at rest. */
typedef struct {
  Knot knots[MAX_KNOTS];
  int num_knots;
  double hold_s;
} Track;

typedef struct {
  double time_s;
  bool is_active;
} SpeechChange;

typedef struct {
  double time_s, level_db;
} Level;

/* Lips in pauses: how far the mouth is ajar. */
typedef struct {
  Level levels[MAX_LEVELS]; /* of future frames */
  int num_levels;
  SpeechChange changes[MAX_CHANGES]; /* of future frames */
  int num_changes;
  bool is_voice, has_spoken, stays_closed;
  double loudest_db, known_s, sound_s, time_s;
  int num_processed_levels;
  double background_db, onset_until_s;
  double goal, start, velocity, duration_s, elapsed_s; /* of the way to the goal */
} Rest;

typedef struct {
  LipPositions queue[MAX_QUEUE]; /* lip positions that are not due yet */
  int num_queued;
  double stable[NUM_MOUTH_FAPS]; /* the last lip positions, stabilized */
  double closing[2];             /* closure fractions of the last two lip positions */
  bool has_lip_positions, is_speaking;
  Track track;
  Mouth on_track, mouth; /* the track and the mouth at the last frame */
  Mouth difference;      /* transition to the track */
  double transition_s, late_s, time_s;
  Rest rest;
  bool at_one[NUM_SHAPES], free[NUM_SHAPES]; /* weights of the last solution: 1, or between 0 and 1 */
} Face;

void face_init(Face *face);
void face_add_lips(Face *face, const LipPositions *frame);
void face_change_speech(Face *face, double time_s, bool is_active);
void face_add_level(Face *face, double time_s, double level_db);
/* Write the weights of the visemes (NUM_SHAPES,) at a media time, seconds. Times must increase. */
void face_visemes(Face *face, double time_s, float *weights);

#endif
