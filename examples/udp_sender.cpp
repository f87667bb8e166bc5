/*
 * A sender for hilstar over UDP, in C++17 on a POSIX machine: a camera turns about its boresight, its attitude leaves at a steady
 * rate, and time requests are answered. The bench file of the other end has `source = "udp"`.
 *
 *     g++ -std=c++17 -O2 -I ../firmware_protocol udp_sender.cpp -o udp_sender
 *     ./udp_sender ADDRESS PORT RATE_HZ SECONDS DEG_PER_S
 *
 * Exit codes: 0 done; 1 the network failed; 2 the command was wrong.
 */
#include <cerrno>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <optional>
#include <utility>

#include <netdb.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include "hilstar_protocol.hpp"

namespace {

constexpr double rad_per_deg = 0.017453292519943295;
constexpr std::int64_t ns_per_ms = 1000000;

std::int64_t clock_ns()
{
    return std::chrono::duration_cast<std::chrono::nanoseconds>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

/** A connected UDP socket: only what comes from that address and port is heard. Closed with its owner. */
class UdpSocket {
public:
    static std::optional<UdpSocket> connected(const char *address, const char *port)
    {
        addrinfo wanted = {};
        addrinfo *found = nullptr;
        wanted.ai_socktype = SOCK_DGRAM;
        if (getaddrinfo(address, port, &wanted, &found) != 0)
            return std::nullopt;
        UdpSocket made(socket(found->ai_family, SOCK_DGRAM, 0));
        const bool done = made.file_ >= 0 && connect(made.file_, found->ai_addr, found->ai_addrlen) == 0;
        freeaddrinfo(found);
        return done ? std::optional<UdpSocket>(std::move(made)) : std::nullopt;
    }

    UdpSocket(UdpSocket &&other) noexcept : file_(std::exchange(other.file_, -1)) {}
    UdpSocket(const UdpSocket &) = delete;
    UdpSocket &operator=(const UdpSocket &) = delete;
    UdpSocket &operator=(UdpSocket &&) = delete;

    ~UdpSocket()
    {
        if (file_ >= 0)
            close(file_);
    }

    template <std::size_t Count>
    bool send(const hilstar::Bytes<Count> &packet) const
    {
        /* Where nobody listens, a send may report that for the one before, and send nothing. */
        for (int tries = 0; tries < 2; tries++)
            if (::send(file_, packet.data(), Count, 0) == static_cast<ssize_t>(Count))
                return true;
        return false;
    }

    /** A packet that comes within so long. */
    std::optional<hilstar::Event> receive(std::int64_t timeout_ns) const
    {
        pollfd asked = {file_, POLLIN, 0};
        hilstar::Bytes<HILSTAR_LONGEST_PACKET + 1> bytes = {};
        if (poll(&asked, 1, static_cast<int>((timeout_ns + ns_per_ms - 1) / ns_per_ms)) <= 0)
            return std::nullopt;
        const ssize_t count = recv(file_, bytes.data(), bytes.size(), 0);
        if (count < 0)
            return std::nullopt;
        return hilstar::decode(bytes.data(), static_cast<std::size_t>(count));
    }

private:
    explicit UdpSocket(int file) : file_(file) {}
    int file_;
};

/** A turn about the camera's +z from RA 0, Dec 0, roll 0. The minus: q turns ICRS components into camera components. */
hilstar::Attitude turned(double angle_rad, double rate_rad_s)
{
    const double w = std::cos(-0.5 * angle_rad), z = std::sin(-0.5 * angle_rad);
    hilstar::Attitude attitude;
    attitude.q_icrs_to_cam = {0.5 * (w - z), 0.5 * (w + z), 0.5 * (z - w), 0.5 * (w + z)};
    attitude.rate_cam_rad_s = {0.0F, 0.0F, static_cast<float>(rate_rad_s)};
    return attitude;
}

struct Heard {
    unsigned long requests = 0, statuses = 0;
};

/** Listen until the clock says `due_ns`, and answer. */
void listen_until(const UdpSocket &road, std::int64_t due_ns, Heard &heard)
{
    for (std::int64_t left_ns = due_ns - clock_ns(); left_ns > 0; left_ns = due_ns - clock_ns()) {
        const auto event = road.receive(left_ns);
        const std::int64_t came_ns = clock_ns();
        if (!event)
            continue;
        if (const auto *request = std::get_if<hilstar::TimeRequest>(&*event)) {
            heard.requests++;
            road.send(hilstar::encode(hilstar::TimeReply{request->sequence, request->t1_ns, came_ns, clock_ns()}));
        }
        heard.statuses += std::holds_alternative<hilstar::Status>(*event) ? 1 : 0;
    }
}

double number(const char *text)
{
    char *end = nullptr;
    const double value = std::strtod(text, &end);
    if (end == text || *end != '\0' || !std::isfinite(value)) {
        std::fprintf(stderr, "%s: write a number\n", text);
        std::exit(2);
    }
    return value;
}

} // namespace

int main(int argc, char **argv)
{
    if (argc != 6) {
        std::fprintf(stderr, "write %s ADDRESS PORT RATE_HZ SECONDS DEG_PER_S\n", argv[0]);
        return 2;
    }
    const double rate_hz = number(argv[3]), seconds = number(argv[4]), rate_rad_s = number(argv[5]) * rad_per_deg;
    if (rate_hz <= 0.0 || seconds <= 0.0) {
        std::fprintf(stderr, "RATE_HZ and SECONDS have to be over 0\n");
        return 2;
    }
    const auto road = UdpSocket::connected(argv[1], argv[2]);
    if (!road) {
        std::fprintf(stderr, "%s %s: %s\n", argv[1], argv[2], errno != 0 ? std::strerror(errno) : "no such address");
        return 1;
    }
    Heard heard;
    std::uint32_t sent = 0;
    const std::int64_t start_ns = clock_ns();
    for (const auto count = static_cast<std::uint32_t>(std::lround(rate_hz * seconds)); sent < count; sent++) {
        const std::int64_t at_ns = start_ns + static_cast<std::int64_t>(sent / rate_hz * 1e9);
        listen_until(*road, at_ns, heard);
        hilstar::Attitude attitude = turned(rate_rad_s * static_cast<double>(at_ns - start_ns) * 1e-9, rate_rad_s);
        attitude.t_ns = at_ns;
        attitude.sequence = sent;
        road->send(hilstar::encode(attitude));
    }
    std::printf("sent %u, requests %lu, statuses %lu\n", sent, heard.requests, heard.statuses);
    return 0;
}
