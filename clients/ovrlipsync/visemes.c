/* Prints the visemes of a sound every 20 ms: visemes RATE_HZ < SAMPLES, 16 bits, mono. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#include "OVRLipSync.h"

int main(int argc, char **argv) {
  const int rate_hz = argc == 2 ? atoi(argv[1]) : 0, buffer_size = rate_hz / 50;
  ovrLipSyncContext context;
  float visemes[ovrLipSyncViseme_Count];
  ovrLipSyncFrame frame = {.visemes = visemes, .visemesLength = ovrLipSyncViseme_Count};
  if (ovrLipSync_Initialize(rate_hz, buffer_size) != ovrLipSyncSuccess) {
    fprintf(stderr, "usage: visemes RATE_HZ < SAMPLES; the rate is 8000 to 192000 Hz\n");
    return 2;
  }
  int16_t *buffer = malloc(buffer_size * sizeof *buffer);
  if (!buffer || ovrLipSync_CreateContext(&context, ovrLipSyncContextProvider_EnhancedWithLaughter) != ovrLipSyncSuccess) return 1;
  while (fread(buffer, sizeof *buffer, buffer_size, stdin) == (size_t)buffer_size) {
    ovrLipSync_ProcessFrameEx(context, buffer, buffer_size, ovrLipSyncAudioDataType_S16_Mono, &frame);
    printf("%d %d %.4f", frame.frameNumber, frame.frameDelay, frame.laughterScore);
    for (int i = 0; i < ovrLipSyncViseme_Count; i++) printf(" %.4f", visemes[i]);
    printf("\n");
  }
  free(buffer);
  return ovrLipSync_Shutdown() != ovrLipSyncSuccess;
}
