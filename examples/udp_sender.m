function sent = udp_sender(address, port, rate_hz, seconds, deg_per_s)
% UDP_SENDER  Send hilstar a camera that turns about its boresight, in datagrams: MATLAB with the Instrument Control Toolbox,
% or Octave with the package instrument-control.
%
%   udp_sender('127.0.0.1', 5560, 200, 10, 0.5)
%
% The bench file of the other end has source = "udp". hilstar's time requests and statuses come back to this end's port and are
% left unread: its clock is then known from the arrivals alone.

if exist('OCTAVE_VERSION', 'builtin')
    pkg('load', 'instrument-control');
end
road = udpport();
rate_rad_s = deg_per_s * pi / 180;
begun = tic();
for sequence = 0:round(rate_hz * seconds) - 1
    pause(max(0, sequence / rate_hz - toc(begun)));
    now_s = toc(begun);
    half_rad = -0.5 * rate_rad_s * now_s;  % q turns ICRS components into camera components: minus
    w = cos(half_rad);
    z = sin(half_rad);
    q = 0.5 * [w - z, w + z, z - w, w + z];  % the turn times [0.5 0.5 -0.5 0.5], which is RA 0, Dec 0, roll 0
    packet = hilstar_packet(sequence, int64(now_s * 1e9), q, [0 0 rate_rad_s]);
    write(road, packet, 'uint8', address, port);
end
sent = round(rate_hz * seconds);
fprintf('sent %d\n', sent);
end
