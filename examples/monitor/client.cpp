// g++ -o client client.cpp; evofsm monitor --udp 4444 & sleep 5; ./client
#include <arpa/inet.h>
#include <cstdio>
#include <cstring>

int main() {
    sockaddr_in monitor{};
    monitor.sin_family = AF_INET;
    monitor.sin_port = htons(4444);
    monitor.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    timeval patience{1, 0};
    int peer = socket(AF_INET, SOCK_DGRAM, 0);
    connect(peer, (sockaddr *)&monitor, sizeof monitor);
    setsockopt(peer, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
    char line[65536];
    for (int k = 0; k < 110; ++k) {
        auto row = R"({"time":%.1f,"gap":%.1f,"v_follower":20,"v_leader":15,"proposal":0})";
        send(peer, line, snprintf(line, sizeof line, row, 0.1 * k, 60 - 0.5 * k), 0);
        auto size = recv(peer, line, sizeof line - 1, 0);
        if (size < 0) return perror("monitor"), 2;  // lost? send it again
        line[size] = 0;
        if (strstr(line, "\"alarm\":true")) return puts(line), 0;
    }
    return 1;
}
