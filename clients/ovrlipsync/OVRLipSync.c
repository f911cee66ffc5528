#include "OVRLipSync.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "lips.h"

enum { MAX_CONTEXTS = 256, MIN_RATE_HZ = 8000, MAX_RATE_HZ = 192000 };

typedef struct {
  Lips *lips; /* NULL if the slot is free */
  bool has_laughter;
  int num_calls;
} Context;

static Context contexts[MAX_CONTEXTS];
static int default_rate_hz, default_buffer_size; /* 0 before Initialize */

static Context *find(ovrLipSyncContext context) {
  const bool is_valid = context >= 1 && context <= MAX_CONTEXTS && contexts[context - 1].lips;
  return is_valid ? &contexts[context - 1] : NULL;
}

static bool is_rate(int rate_hz) { return rate_hz >= MIN_RATE_HZ && rate_hz <= MAX_RATE_HZ; }

ovrLipSyncResult ovrLipSync_Initialize(int sampleRate, int bufferSize) {
  if (!is_rate(sampleRate)) return ovrLipSyncError_BadSampleRate;
  if (bufferSize < 1) return ovrLipSyncError_InvalidParam;
  lips_init();
  default_rate_hz = sampleRate;
  default_buffer_size = bufferSize;
  return ovrLipSyncSuccess;
}

ovrLipSyncResult ovrLipSync_InitializeEx(int sampleRate, int bufferSize, const char *path) {
  (void)path;
  return ovrLipSync_Initialize(sampleRate, bufferSize);
}

ovrLipSyncResult ovrLipSync_Shutdown(void) {
  for (ovrLipSyncContext context = 1; context <= MAX_CONTEXTS; context++) ovrLipSync_DestroyContext(context);
  default_rate_hz = default_buffer_size = 0;
  return ovrLipSyncSuccess;
}

const char *ovrLipSync_GetVersion(int *major, int *minor, int *patch) {
  if (major) *major = OVR_LIPSYNC_MAJOR_VERSION;
  if (minor) *minor = OVR_LIPSYNC_MINOR_VERSION;
  if (patch) *patch = OVR_LIPSYNC_PATCH_VERSION;
  return "kouxing, with the interface of OVRLipSync 1.61.0";
}

ovrLipSyncResult ovrLipSync_CreateContext(ovrLipSyncContext *pContext, ovrLipSyncContextProvider provider) {
  return ovrLipSync_CreateContextEx(pContext, provider, 0, false);
}

ovrLipSyncResult ovrLipSync_CreateContextEx(ovrLipSyncContext *pContext, ovrLipSyncContextProvider provider,
                                            int sampleRate, bool enableAcceleration) {
  (void)enableAcceleration;
  const int rate_hz = sampleRate ? sampleRate : default_rate_hz;
  if (!pContext) return ovrLipSyncError_InvalidParam;
  if (!default_rate_hz) return ovrLipSyncError_CannotCreateContext; /* Initialize was not called */
  if (!is_rate(rate_hz)) return ovrLipSyncError_BadSampleRate;
  for (int place = 0; place < MAX_CONTEXTS; place++) {
    if (contexts[place].lips) continue;
    Context created = {lips_create(rate_hz), provider == ovrLipSyncContextProvider_EnhancedWithLaughter, 0};
    if (!created.lips) return ovrLipSyncError_CannotCreateContext;
    contexts[place] = created;
    *pContext = place + 1;
    return ovrLipSyncSuccess;
  }
  return ovrLipSyncError_CannotCreateContext;
}

ovrLipSyncResult ovrLipSync_DestroyContext(ovrLipSyncContext context) {
  Context *found = find(context);
  if (!found) return ovrLipSyncError_InvalidParam;
  lips_destroy(found->lips);
  memset(found, 0, sizeof *found);
  return ovrLipSyncSuccess;
}

ovrLipSyncResult ovrLipSync_ResetContext(ovrLipSyncContext context) {
  Context *found = find(context);
  if (!found) return ovrLipSyncError_InvalidParam;
  lips_reset(found->lips);
  found->num_calls = 0;
  return ovrLipSyncSuccess;
}

ovrLipSyncResult ovrLipSync_SendSignal(ovrLipSyncContext context, ovrLipSyncSignals signal, int arg1, int arg2) {
  (void)arg2;
  if (!find(context)) return ovrLipSyncError_InvalidParam;
  if (signal != ovrLipSyncSignals_VisemeSmoothing) return ovrLipSyncError_UndefinedFunction;
  return arg1 >= 1 && arg1 <= 100 ? ovrLipSyncSuccess : ovrLipSyncError_InvalidParam;
}

/* Return a sample as mono, in [-1, 1]; values that are not finite are silence. */
static float sample_at(const void *buffer, ovrLipSyncAudioDataType type, int i) {
  const int16_t *integers = buffer;
  const float *floats = buffer;
  float sample = 0.0f;
  switch (type) {
    case ovrLipSyncAudioDataType_S16_Mono: return integers[i] / 32768.0f;
    case ovrLipSyncAudioDataType_S16_Stereo: return (integers[2 * i] + integers[2 * i + 1]) / 65536.0f;
    case ovrLipSyncAudioDataType_F32_Mono: sample = floats[i]; break;
    case ovrLipSyncAudioDataType_F32_Stereo: sample = 0.5f * (floats[2 * i] + floats[2 * i + 1]); break;
  }
  return isfinite(sample) ? fminf(fmaxf(sample, -1.0f), 1.0f) : 0.0f;
}

ovrLipSyncResult ovrLipSync_ProcessFrameEx(ovrLipSyncContext context, const void *audioBuffer, int sampleCount,
                                           ovrLipSyncAudioDataType dataType, ovrLipSyncFrame *pFrame) {
  Context *found = find(context);
  if (!found || !audioBuffer || sampleCount < 0 || dataType > ovrLipSyncAudioDataType_F32_Stereo) return ovrLipSyncError_InvalidParam;
  if (!pFrame || !pFrame->visemes || pFrame->visemesLength < LIPS_NUM_VISEMES) return ovrLipSyncError_InvalidParam;
  for (int begin = 0; begin < sampleCount; begin += LIPS_MAX_CHUNK) {
    float chunk[LIPS_MAX_CHUNK];
    const int size = sampleCount - begin < LIPS_MAX_CHUNK ? sampleCount - begin : LIPS_MAX_CHUNK;
    for (int i = 0; i < size; i++) chunk[i] = sample_at(audioBuffer, dataType, begin + i);
    lips_push(found->lips, chunk, size);
  }
  pFrame->frameNumber = found->num_calls++;
  pFrame->frameDelay = (int)lround(1000.0 * lips_newest(found->lips, pFrame->visemes));
  pFrame->laughterScore = found->has_laughter ? lips_laughter(found->lips) : 0.0f;
  return ovrLipSyncSuccess;
}

ovrLipSyncResult ovrLipSync_ProcessFrame(ovrLipSyncContext context, const float *audioBuffer, ovrLipSyncFrame *pFrame) {
  return ovrLipSync_ProcessFrameEx(context, audioBuffer, default_buffer_size, ovrLipSyncAudioDataType_F32_Mono, pFrame);
}

ovrLipSyncResult ovrLipSync_ProcessFrameInterleaved(ovrLipSyncContext context, const float *audioBuffer, ovrLipSyncFrame *pFrame) {
  return ovrLipSync_ProcessFrameEx(context, audioBuffer, default_buffer_size, ovrLipSyncAudioDataType_F32_Stereo, pFrame);
}
