/* kouxing lip sync with the API of OVRLipSync 1.61; docs/clients/ovrlipsync.md lists the differences.
 *
 * Contexts are independent. Different threads may process different contexts at the same time. Create and
 * destroy contexts, initialize and shut down in one thread. */
#ifndef OVR_LipSync_H
#define OVR_LipSync_H

#include <stdbool.h>

#if defined(_WIN32) && defined(OVR_LIPSYNC_BUILD)
#define OVR_LIPSYNC_API __declspec(dllexport)
#elif defined(_WIN32)
#define OVR_LIPSYNC_API __declspec(dllimport)
#else
#define OVR_LIPSYNC_API __attribute__((visibility("default")))
#endif

#ifdef __cplusplus
extern "C" {
#endif

#define OVR_LIPSYNC_MAJOR_VERSION 1
#define OVR_LIPSYNC_MINOR_VERSION 61
#define OVR_LIPSYNC_PATCH_VERSION 0

typedef enum {
  ovrLipSyncSuccess = 0,
  ovrLipSyncError_Unknown = -2200,
  ovrLipSyncError_CannotCreateContext = -2201,
  ovrLipSyncError_InvalidParam = -2202,
  ovrLipSyncError_BadSampleRate = -2203,
  ovrLipSyncError_MissingDLL = -2204,
  ovrLipSyncError_BadVersion = -2205,
  ovrLipSyncError_UndefinedFunction = -2206
} ovrLipSyncResult;

typedef enum {
  ovrLipSyncAudioDataType_S16_Mono,
  ovrLipSyncAudioDataType_S16_Stereo,
  ovrLipSyncAudioDataType_F32_Mono,
  ovrLipSyncAudioDataType_F32_Stereo
} ovrLipSyncAudioDataType;

typedef enum {
  ovrLipSyncViseme_sil,
  ovrLipSyncViseme_PP,
  ovrLipSyncViseme_FF,
  ovrLipSyncViseme_TH,
  ovrLipSyncViseme_DD,
  ovrLipSyncViseme_kk,
  ovrLipSyncViseme_CH,
  ovrLipSyncViseme_SS,
  ovrLipSyncViseme_nn,
  ovrLipSyncViseme_RR,
  ovrLipSyncViseme_aa,
  ovrLipSyncViseme_E,
  ovrLipSyncViseme_ih,
  ovrLipSyncViseme_oh,
  ovrLipSyncViseme_ou,
  ovrLipSyncViseme_Count
} ovrLipSyncViseme;

typedef enum { ovrLipSyncLaughterCategory_Count } ovrLipSyncLaughterCategory;

typedef enum {
  ovrLipSyncSignals_VisemeOn,
  ovrLipSyncSignals_VisemeOff,
  ovrLipSyncSignals_VisemeAmount,
  ovrLipSyncSignals_VisemeSmoothing,
  ovrLipSyncSignals_LaughterAmount,
  ovrLipSyncSignals_Count
} ovrLipSyncSignals;

typedef enum {
  ovrLipSyncContextProvider_Original,
  ovrLipSyncContextProvider_Enhanced,
  ovrLipSyncContextProvider_EnhancedWithLaughter
} ovrLipSyncContextProvider;

typedef struct {
  int frameNumber;             /* calls for this context so far */
  int frameDelay;              /* time from the face to the end of the audio, ms */
  float *visemes;              /* the caller's array; weights 0 to 1 are written to it */
  unsigned int visemesLength;  /* its length, at least ovrLipSyncViseme_Count */
  float laughterScore;         /* 0 to 1, for ovrLipSyncContextProvider_EnhancedWithLaughter */
  float *laughterCategories;   /* not used */
  unsigned int laughterCategoriesLength;
} ovrLipSyncFrame;

typedef unsigned int ovrLipSyncContext; /* 0 is invalid */

/* Set the sample rate, 8000 to 192000 Hz, and the samples of each channel in a buffer of ProcessFrame. */
OVR_LIPSYNC_API ovrLipSyncResult ovrLipSync_Initialize(int sampleRate, int bufferSize);
/* Like ovrLipSync_Initialize. The path is ignored, because the model is part of the library. */
OVR_LIPSYNC_API ovrLipSyncResult ovrLipSync_InitializeEx(int sampleRate, int bufferSize, const char *path);
/* Destroy all contexts. */
OVR_LIPSYNC_API ovrLipSyncResult ovrLipSync_Shutdown(void);
OVR_LIPSYNC_API const char *ovrLipSync_GetVersion(int *major, int *minor, int *patch);

OVR_LIPSYNC_API ovrLipSyncResult ovrLipSync_CreateContext(ovrLipSyncContext *pContext,
                                                          ovrLipSyncContextProvider provider);
/* If the sample rate is 0, the rate of ovrLipSync_Initialize is used. */
OVR_LIPSYNC_API ovrLipSyncResult ovrLipSync_CreateContextEx(ovrLipSyncContext *pContext,
                                                            ovrLipSyncContextProvider provider,
                                                            int sampleRate, bool enableAcceleration);
OVR_LIPSYNC_API ovrLipSyncResult ovrLipSync_DestroyContext(ovrLipSyncContext context);
/* Forget the audio so far, for example before another speaker. */
OVR_LIPSYNC_API ovrLipSyncResult ovrLipSync_ResetContext(ovrLipSyncContext context);
/* VisemeSmoothing (1 to 100) is accepted and has no effect. Other signals return ovrLipSyncError_UndefinedFunction. */
OVR_LIPSYNC_API ovrLipSyncResult ovrLipSync_SendSignal(ovrLipSyncContext context, ovrLipSyncSignals signal,
                                                       int arg1, int arg2);

/* Process a mono buffer of the size given to ovrLipSync_Initialize, and write the newest face to pFrame. */
OVR_LIPSYNC_API ovrLipSyncResult ovrLipSync_ProcessFrame(ovrLipSyncContext context, const float *audioBuffer,
                                                         ovrLipSyncFrame *pFrame);
/* Like ovrLipSync_ProcessFrame, for interleaved stereo. */
OVR_LIPSYNC_API ovrLipSyncResult ovrLipSync_ProcessFrameInterleaved(ovrLipSyncContext context,
                                                                    const float *audioBuffer,
                                                                    ovrLipSyncFrame *pFrame);
/* Like ovrLipSync_ProcessFrame, for sampleCount samples of each channel. */
OVR_LIPSYNC_API ovrLipSyncResult ovrLipSync_ProcessFrameEx(ovrLipSyncContext context, const void *audioBuffer,
                                                           int sampleCount, ovrLipSyncAudioDataType dataType,
                                                           ovrLipSyncFrame *pFrame);

#ifdef __cplusplus
}
#endif

#endif
