/*
 * A star tracker's answers in one file: what its firmware does, on a POSIX machine. Each is a packet of kind 5, framed for a
 * serial line. The bench file of the other end has [answers] with source = "serial".
 *
 *     cc -std=c99 -D_POSIX_C_SOURCE=200809L -O2 -I ../firmware_protocol serial_tracker.c -o serial_tracker
 *     stty -F /dev/ttyUSB0 raw 115200 && ./serial_tracker /dev/ttyUSB0 RATE_HZ COUNT
 *
 * Exit codes: 0 done; 1 the device failed; 2 the command was wrong.
 */
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

#include "hilstar_protocol.h"

#define NS_PER_S 1000000000LL

/** The tracker's clock, ns. Firmware has a hardware timer here. */
static int64_t tracker_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * NS_PER_S + now.tv_nsec;
}

int main(int argc, char **argv)
{
    const double rate_hz = argc == 4 ? atof(argv[2]) : 0.0;
    const long count = argc == 4 ? atol(argv[3]) : 0;
    long sent;
    int line;
    if (rate_hz <= 0.0 || count <= 0) {
        fprintf(stderr, "write %s DEVICE RATE_HZ COUNT\n", argv[0]);
        return 2;
    }
    line = open(argv[1], O_WRONLY | O_NOCTTY);
    for (sent = 0; line >= 0 && sent < count; sent++) {
        const struct timespec wait = {(time_t)(1.0 / rate_hz), (long)((int64_t)(1e9 / rate_hz) % NS_PER_S)};
        hilstar_answer answer = {0};
        uint8_t packet[HILSTAR_ANSWER_BYTES], wire[HILSTAR_LONGEST_FRAME];
        size_t length;
        answer.flags = HILSTAR_ANSWER_VALID | HILSTAR_ANSWER_TRACKING; /* and _RATE_VALID where rate_cam_rad_s is known */
        answer.sequence = (uint32_t)sent;
        answer.t_ns = tracker_ns(); /* the middle of the exposure */
        answer.q_icrs_to_cam[0] = answer.q_icrs_to_cam[1] = answer.q_icrs_to_cam[3] = 0.5; /* RA 0, Dec 0, roll 0 */
        answer.q_icrs_to_cam[2] = -0.5;
        answer.stars = 12;
        length = hilstar_frame(packet, hilstar_encode_answer(&answer, packet), wire);
        if (write(line, wire, length) != (ssize_t)length)
            break;
        nanosleep(&wait, NULL);
    }
    if (line < 0 || sent < count || close(line) < 0) {
        perror(argv[1]);
        return 1;
    }
    printf("sent %ld\n", sent);
    return 0;
}
