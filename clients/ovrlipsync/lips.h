/* Lip sync of one voice: samples in, visemes out. */
#ifndef LIPS_H
#define LIPS_H

enum { LIPS_NUM_VISEMES = 15, LIPS_MAX_CHUNK = 1024 };

typedef struct Lips Lips;

/* Prepare this library; call it first, in one thread. */
void lips_init(void);
/* Start a session; NULL if memory cannot be allocated. The rate is 8000 to 192000 Hz. */
Lips *lips_create(int rate_hz);
void lips_destroy(Lips *lips);
/* Forget the audio so far. */
void lips_reset(Lips *lips);
/* Process at most LIPS_MAX_CHUNK mono samples in [-1, 1]. */
void lips_push(Lips *lips, const float *samples, int num_samples);
/* Write the newest weights (LIPS_NUM_VISEMES,); return the time from them to the end of the audio, seconds. */
double lips_newest(const Lips *lips, float *weights);
/* Return the evidence of laughter, 0 to 1. */
float lips_laughter(const Lips *lips);

#endif
