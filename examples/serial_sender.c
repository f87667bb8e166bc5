/*
 * A sender for hilstar in one file: what firmware does, on a POSIX machine. It turns a camera about its boresight, sends its
 * attitude over a serial line at a steady rate, answers time requests, and counts the statuses that come back.
 *
 *     cc -std=c99 -D_POSIX_C_SOURCE=200809L -O2 -I ../firmware_protocol serial_sender.c -lm -o serial_sender
 *     ./serial_sender DEVICE BAUD RATE_HZ SECONDS DEG_PER_S [CLOCK_OFFSET_S]
 *
 * CLOCK_OFFSET_S sets this sender's clock ahead of the machine's; hilstar finds the offset by its time requests.
 * Exit codes: 0 done; 1 the device failed; 2 the command was wrong.
 */
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/select.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "hilstar_protocol.h"

#define NS_PER_S 1000000000LL
#define RAD_PER_DEG 0.017453292519943295

static int64_t clock_offset_ns;

/** The sender's clock, ns. Firmware has a hardware timer here. */
static int64_t sender_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * NS_PER_S + now.tv_nsec + clock_offset_ns;
}

static void die(const char *what)
{
    perror(what);
    exit(1);
}

/* ---- the line ---- */

static speed_t speed_of(long baud)
{
    switch (baud) {
    case 9600: return B9600;
    case 19200: return B19200;
    case 38400: return B38400;
#ifdef B57600
    case 57600: return B57600;
#endif
#ifdef B115200
    case 115200: return B115200;
#endif
#ifdef B230400
    case 230400: return B230400;
#endif
#ifdef B460800
    case 460800: return B460800;
#endif
#ifdef B921600
    case 921600: return B921600;
#endif
#ifdef B3000000
    case 3000000: return B3000000;
#endif
    default: fprintf(stderr, "%ld: no baud rate that this machine has; write one such as 115200\n", baud); exit(2);
    }
}

/** Open a device raw: 8 bits, no parity, one stop bit, no flow control, every byte as it is. */
static int open_line(const char *device, long baud)
{
    const speed_t speed = speed_of(baud);
    struct termios settings;
    const int line = open(device, O_RDWR | O_NOCTTY);
    if (line < 0 || tcgetattr(line, &settings) < 0)
        die(device);
    settings.c_iflag = 0;
    settings.c_oflag = 0;
    settings.c_lflag = 0;
    settings.c_cflag = CS8 | CREAD | CLOCAL;
    settings.c_cc[VMIN] = 1;
    settings.c_cc[VTIME] = 0;
    if (cfsetispeed(&settings, speed) < 0 || cfsetospeed(&settings, speed) < 0 || tcsetattr(line, TCSANOW, &settings) < 0)
        die(device);
    return line;
}

static void write_all(int line, const uint8_t *bytes, size_t length)
{
    while (length) {
        const ssize_t written = write(line, bytes, length);
        if (written < 0 && errno != EINTR)
            die("write");
        if (written > 0) {
            bytes += written;
            length -= (size_t)written;
        }
    }
}

static void send_packet(int line, const uint8_t *packet, size_t length)
{
    uint8_t wire[HILSTAR_LONGEST_FRAME];
    write_all(line, wire, hilstar_frame(packet, length, wire));
}

/* ---- what comes ---- */

typedef struct {
    hilstar_decoder decoder;
    unsigned long requests, statuses;
} listener;

static void answer(int line, const hilstar_decoder *decoder, int64_t t2_ns)
{
    uint8_t packet[HILSTAR_TIME_REPLY_BYTES];
    hilstar_time_request request;
    hilstar_time_reply reply;
    if (hilstar_decode_time_request(decoder->packet, decoder->length, &request) < 0)
        return;
    reply.sequence = request.sequence;
    reply.t1_ns = request.t1_ns;
    reply.t2_ns = t2_ns;
    reply.t3_ns = sender_ns();
    send_packet(line, packet, hilstar_encode_time_reply(&reply, packet));
}

static void take_bytes(int line, listener *heard)
{
    uint8_t bytes[256];
    const ssize_t count = read(line, bytes, sizeof bytes);
    const int64_t came_ns = sender_ns(); /* before anything else: it is the t2 of a request */
    ssize_t i;
    if (count <= 0 && !(count < 0 && errno == EINTR))
        die("read");
    for (i = 0; i < count; i++) {
        switch (hilstar_push(&heard->decoder, bytes[i])) {
        case HILSTAR_KIND_TIME_REQUEST:
            heard->requests++;
            answer(line, &heard->decoder, came_ns);
            break;
        case HILSTAR_KIND_STATUS: heard->statuses++; break;
        default: break;
        }
    }
}

/** Listen until the sender's clock says `due_ns`. The deadline is absolute, so no lateness adds up. */
static void listen_until(int line, int64_t due_ns, listener *heard)
{
    int64_t left_ns;
    while ((left_ns = due_ns - sender_ns()) > 0) {
        struct timespec wait;
        fd_set ready;
        int count;
        wait.tv_sec = (time_t)(left_ns / NS_PER_S);
        wait.tv_nsec = (long)(left_ns % NS_PER_S);
        FD_ZERO(&ready);
        FD_SET(line, &ready);
        count = pselect(line + 1, &ready, NULL, NULL, &wait, NULL);
        if (count < 0 && errno != EINTR)
            die("pselect");
        if (count > 0)
            take_bytes(line, heard);
    }
}

/* ---- what goes ---- */

/**
 * A turn by `angle_rad` about the camera's +z: q(t) = [cos(-a/2), 0, 0, sin(-a/2)] q0, a Hamilton product. The minus:
 * q turns ICRS components into camera components, and a fixed star seems to turn against the camera.
 */
static void turned(double angle_rad, double q[4])
{
    static const double q0[4] = {0.5, 0.5, -0.5, 0.5}; /* RA 0, Dec 0, roll 0 */
    const double w = cos(-0.5 * angle_rad), z = sin(-0.5 * angle_rad);
    q[0] = w * q0[0] - z * q0[3];
    q[1] = w * q0[1] - z * q0[2];
    q[2] = w * q0[2] + z * q0[1];
    q[3] = w * q0[3] + z * q0[0];
}

static void send_attitude(int line, uint32_t sequence, int64_t t_ns, double angle_rad, double rate_rad_s)
{
    uint8_t packet[HILSTAR_ATTITUDE_BYTES];
    hilstar_attitude attitude;
    memset(&attitude, 0, sizeof attitude);
    attitude.flags = HILSTAR_FLAG_RATE_VALID;
    attitude.sequence = sequence;
    attitude.t_ns = t_ns;
    turned(angle_rad, attitude.q_icrs_to_cam);
    attitude.rate_cam_rad_s[2] = (float)rate_rad_s;
    send_packet(line, packet, hilstar_encode_attitude(&attitude, packet));
}

static double number(const char *text)
{
    char *end;
    const double value = strtod(text, &end);
    if (end == text || *end || !isfinite(value)) {
        fprintf(stderr, "%s: write a number\n", text);
        exit(2);
    }
    return value;
}

int main(int argc, char **argv)
{
    const uint8_t delimiter = 0; /* ends whatever half frame is on the line */
    listener heard;
    uint32_t sent = 0;
    int64_t start_ns, at_ns;
    double rate_hz, seconds, rate_rad_s;
    int line;
    if (argc < 6 || argc > 7) {
        fprintf(stderr, "write %s DEVICE BAUD RATE_HZ SECONDS DEG_PER_S [CLOCK_OFFSET_S]\n", argv[0]);
        return 2;
    }
    rate_hz = number(argv[3]);
    seconds = number(argv[4]);
    rate_rad_s = number(argv[5]) * RAD_PER_DEG;
    clock_offset_ns = (int64_t)(argc > 6 ? number(argv[6]) * 1e9 : 0.0);
    if (rate_hz <= 0.0 || seconds <= 0.0) {
        fprintf(stderr, "RATE_HZ and SECONDS have to be over 0\n");
        return 2;
    }
    line = open_line(argv[1], (long)number(argv[2]));
    memset(&heard, 0, sizeof heard);
    hilstar_decoder_init(&heard.decoder);
    write_all(line, &delimiter, 1);
    start_ns = sender_ns();
    for (at_ns = 0; at_ns < (int64_t)(seconds * 1e9); at_ns = (int64_t)((double)sent / rate_hz * 1e9)) {
        listen_until(line, start_ns + at_ns, &heard);
        send_attitude(line, sent++, start_ns + at_ns, rate_rad_s * 1e-9 * (double)at_ns, rate_rad_s);
    }
    listen_until(line, start_ns + (int64_t)(seconds * 1e9), &heard);
    tcdrain(line);
    close(line);
    printf("sent %lu, requests %lu, statuses %lu\n", (unsigned long)sent, heard.requests, heard.statuses);
    return 0;
}
