/*
 * A star tracker's answers over UDP, in C++17 on a POSIX machine: a packet of kind 5 in each datagram. The bench file of the
 * other end has [answers] with source = "udp".
 *
 *     g++ -std=c++17 -O2 -I ../firmware_protocol udp_tracker.cpp -o udp_tracker
 *     ./udp_tracker ADDRESS PORT RATE_HZ COUNT
 *
 * Exit codes: 0 done; 1 the network failed; 2 the command was wrong.
 */
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <thread>

#include <netdb.h>
#include <sys/socket.h>
#include <unistd.h>

#include "hilstar_protocol.hpp"

int main(int argc, char **argv)
{
    using clock = std::chrono::steady_clock;
    const double rate_hz = argc == 5 ? std::atof(argv[3]) : 0.0;
    const long count = argc == 5 ? std::atol(argv[4]) : 0;
    if (rate_hz <= 0.0 || count <= 0) {
        std::fprintf(stderr, "write %s ADDRESS PORT RATE_HZ COUNT\n", argv[0]);
        return 2;
    }
    addrinfo wanted = {}, *found = nullptr;
    wanted.ai_socktype = SOCK_DGRAM;
    if (getaddrinfo(argv[1], argv[2], &wanted, &found) != 0) {
        std::fprintf(stderr, "%s %s: no such address\n", argv[1], argv[2]);
        return 1;
    }
    const int road = socket(found->ai_family, SOCK_DGRAM, 0);
    hilstar::Answer answer;
    answer.flags = HILSTAR_ANSWER_VALID | HILSTAR_ANSWER_TRACKING; /* and _RATE_VALID where rate_cam_rad_s is known */
    answer.q_icrs_to_cam = {0.5, 0.5, -0.5, 0.5};                  /* RA 0, Dec 0, roll 0 */
    answer.stars = 12;
    long sent = 0;
    for (; road >= 0 && sent < count; sent++) {
        answer.sequence = static_cast<std::uint32_t>(sent);
        const auto now = clock::now().time_since_epoch(); /* the middle of the exposure */
        answer.t_ns = std::chrono::duration_cast<std::chrono::nanoseconds>(now).count();
        const auto packet = hilstar::encode(answer);
        if (sendto(road, packet.data(), packet.size(), 0, found->ai_addr, found->ai_addrlen) < 0)
            break;
        std::this_thread::sleep_for(std::chrono::duration<double>(1.0 / rate_hz));
    }
    freeaddrinfo(found);
    if (road < 0 || sent < count || close(road) < 0) {
        std::perror(argv[1]);
        return 1;
    }
    std::printf("sent %ld\n", sent);
    return 0;
}
